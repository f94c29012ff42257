"""One crop for a whole clip, so that the camera stays a camera: a head that moves, moves in the picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.source import shrunk_size

_MARGIN = 1.5
"""Face boxes (eyebrows to chin) of room around all positions of the face, for hair, neck and shoulders."""
_OUTLIERS = 1.0
"""Percent of the frames at either end that may lie outside: a false detection must not decide."""
_SQUARISH = 1.25
"""A picture of up to this aspect..."""
_MOSTLY_HEAD = 0.7
"""...of which the head crop would take at least this part is a head crop already, and kept whole."""


@dataclass(frozen=True)
class Crop:
    """A part of the source picture and the size it is shrunk to, all in pixels."""

    left: int
    top: int
    crop_width: int
    crop_height: int
    width: int
    height: int

    @property
    def scale(self) -> Float[np.ndarray, " 2"]:
        """Output pixels a source pixel, along x and y."""
        return np.array([self.width / self.crop_width, self.height / self.crop_height])

    def to_output(self, source_pixels: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Source pixels as pixels of the output."""
        return (source_pixels - np.array([self.left, self.top])) * self.scale

    def apply(self, image: UInt8[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h2 w2 *channels"]:
        """Cut out and shrink (area-averaged)."""
        part = image[self.top : self.top + self.crop_height, self.left : self.left + self.crop_width]
        if (self.crop_width, self.crop_height) == (self.width, self.height):
            return np.ascontiguousarray(part)
        shrunk = cv2.resize(part, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return shrunk.astype(np.uint8, copy=False)


def whole_picture(width: int, height: int, size: int) -> Crop:
    """No crop, only shrunk so that the longer side has at most `size` pixels."""
    width_out, height_out = shrunk_size(width, height, size)
    return Crop(0, 0, width, height, width_out, height_out)


def choose_crop(boxes: Float[np.ndarray, "t 4"], width: int, height: int, size: int) -> Crop:
    """A square that holds the head over the whole clip, inside the picture; or the picture, if it is a head crop.

    Args:
        boxes: left, top, right, bottom of the face as fractions of the picture; NaN where there is none.
        width: of the source picture, pixels.
        height: of the source picture, pixels.
        size: pixels a side of the result; smaller crops are not enlarged.
    """
    pixels = boxes[np.isfinite(boxes).all(axis=1)] * np.array([width, height, width, height])
    assert len(pixels) > 0
    left, top = np.percentile(pixels[:, :2], _OUTLIERS, axis=0)
    right, bottom = np.percentile(pixels[:, 2:], 100 - _OUTLIERS, axis=0)
    face = float(np.median(np.maximum(pixels[:, 2] - pixels[:, 0], pixels[:, 3] - pixels[:, 1])))
    wanted = max(right - left, bottom - top) + _MARGIN * face
    shorter, longer = min(width, height), max(width, height)
    if longer <= _SQUARISH * shorter and wanted >= _MOSTLY_HEAD * shorter:
        return whole_picture(width, height, size)
    side = min(round(wanted), shorter)
    crop_left = int(np.clip(round((left + right - side) / 2), 0, width - side))
    crop_top = int(np.clip(round((top + bottom - side) / 2), 0, height - side))
    return Crop(crop_left, crop_top, side, side, min(side, size), min(side, size))
