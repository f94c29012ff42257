"""Pictures for people: side by side, error heat maps, contact sheets. All are uint8 RGB arrays."""

import base64
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

WHITE = 255
HEAT_STOPS = ((0, 0, 4), (66, 10, 104), (147, 38, 103), (221, 81, 58), (252, 165, 10), (252, 255, 164))
"""Colours of the heat scale from 0 to its limit: matplotlib's `inferno` at six even steps."""


def to_uint8(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image in 0..1 as bytes, clamped and rounded."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def heat_colors(values: Float[np.ndarray, "*s"]) -> UInt8[np.ndarray, "*s 3"]:
    """Colours from black over red to pale yellow for values from 0 to 1, clamped."""
    stops = np.array(HEAT_STOPS, dtype=np.float32)
    position = np.clip(values, 0, 1).astype(np.float32) * (len(stops) - 1)
    below = np.minimum(position.astype(np.int64), len(stops) - 2)
    along = (position - below)[..., None]
    return np.rint(stops[below] * (1 - along) + stops[below + 1] * along).astype(np.uint8)


def error_heat(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], limit: float = 0.25
) -> UInt8[np.ndarray, "h w 3"]:
    """The mean absolute difference of the channels as a heat map. `limit` (0..1) and above get the brightest colour."""
    difference = (image - target).abs().mean(-1) / limit
    return heat_colors(difference.detach().cpu().numpy().astype(np.float32))


def side_by_side(images: Sequence[UInt8[np.ndarray, "_ _ 3"]], gap: int = 4) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures in a row, scaled to the first one's height, with white gaps of `gap` pixels."""
    assert images, "no pictures"
    height = images[0].shape[0]
    row: list[np.ndarray] = []
    for image in images:
        row += [np.full((height, gap, 3), WHITE, np.uint8), _scaled_to_height(image, height)]
    return np.concatenate(row[1:], axis=1)


def contact_sheet(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]], columns: int, gap: int = 4
) -> UInt8[np.ndarray, "h w 3"]:
    """Pictures of one size in rows of `columns`. The last row is filled with white."""
    assert images, "no pictures"
    blank = np.full_like(images[0], WHITE)
    padded = [*images, *([blank] * (-len(images) % columns))]
    rows = [side_by_side(padded[start : start + columns], gap) for start in range(0, len(padded), columns)]
    between = np.full((gap, rows[0].shape[1], 3), WHITE, np.uint8)
    stacked = [part for row in rows for part in (between, row)]
    return np.concatenate(stacked[1:], axis=0)


def shrunk(image: UInt8[np.ndarray, "_ _ 3"], largest: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """The picture with its longer side at most `largest` pixels, by area averaging. It is never enlarged."""
    factor = largest / max(image.shape[:2])
    if factor >= 1:
        return image
    size = (max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def data_uri(image: UInt8[np.ndarray, "_ _ 3"], jpeg_quality: int | None = 90) -> str:
    """The picture as a data URI for HTML: JPEG of the given quality, or lossless PNG if it is None."""
    kind = "png" if jpeg_quality is None else "jpeg"
    options = [] if jpeg_quality is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    done, encoded = cv2.imencode(f".{kind}", np.ascontiguousarray(image[:, :, ::-1]), options)
    assert done, f"cannot encode a picture of shape {image.shape}"
    return f"data:image/{kind};base64,{base64.b64encode(encoded.tobytes()).decode('ascii')}"


def _scaled_to_height(image: UInt8[np.ndarray, "_ _ 3"], height: int) -> UInt8[np.ndarray, "_ _ 3"]:
    if image.shape[0] == height:
        return image
    width = max(1, round(image.shape[1] * height / image.shape[0]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
