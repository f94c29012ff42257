"""Pictures for people: side by side, in a grid, heat maps, inside HTML. All are uint8 RGB arrays."""

import base64
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.media.picture_files import encode_picture

WHITE = 255
ERROR_LIMIT = 0.25
"""Error, for colours in 0..1, that gets the brightest colour of `error_heat`. Pages say 64 of 255."""


def to_uint8(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image in 0..1 as bytes, clamped and rounded."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def heat_colors(values: Float[np.ndarray, "h w"], limit: float = 1.0) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of `inferno`, from black over red to pale yellow, for values from 0 to `limit`. NaN is black."""
    levels = np.clip(np.nan_to_num(values) * (255 / limit), 0, 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def error_heat(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], limit: float = ERROR_LIMIT
) -> UInt8[np.ndarray, "h w 3"]:
    """The mean absolute difference of the channels as a heat map. `limit` (0..1) and above get the brightest colour."""
    difference = (image - target).abs().mean(-1)
    return heat_colors(difference.detach().cpu().numpy().astype(np.float32), limit)


def side_by_side(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]], gap: int = 4, color: int | tuple[int, int, int] = WHITE
) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures in a row, scaled to the first one's height, with gaps of `gap` pixels in a colour."""
    assert images, "no pictures"
    height = images[0].shape[0]
    row: list[np.ndarray] = []
    for image in images:
        size = (max(1, round(image.shape[1] * height / image.shape[0])), height)
        scaled = image if image.shape[0] == height else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        row += [np.full((height, gap, 3), color, np.uint8), scaled]
    return np.concatenate(row[1:], axis=1)


def picture_grid(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    columns: int,
    gap: int = 4,
    color: int | tuple[int, int, int] = WHITE,
) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures of one size in rows of `columns`. A colour is that of gaps of `gap` pixels, and fills the last row."""
    assert images, "no pictures"
    blank = np.full_like(images[0], color)
    padded = [*images, *([blank] * (-len(images) % columns))]
    rows = [side_by_side(padded[start : start + columns], gap, color) for start in range(0, len(padded), columns)]
    between = np.full((gap, rows[0].shape[1], 3), color, np.uint8)
    stacked = [part for row in rows for part in (between, row)]
    return np.concatenate(stacked[1:], axis=0)


def shrink(image: UInt8[np.ndarray, "_ _ 3"], largest: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Shrink a picture by area averaging until its longer side has at most `largest` pixels. It is never enlarged."""
    factor = largest / max(image.shape[:2])
    if factor >= 1:
        return image
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def picture_uri(image: UInt8[np.ndarray, "_ _ 3"], jpeg_quality: int | None = 90) -> str:
    """The picture as a data URI for HTML: JPEG of the given quality, or lossless PNG if it is None."""
    if jpeg_quality is None:
        return data_uri("image/png", encode_picture(image))
    return data_uri("image/jpeg", encode_picture(image, ".jpeg", (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality)))


def data_uri(media_type: str, data: bytes) -> str:
    """The content of a file as a data URI for HTML."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
