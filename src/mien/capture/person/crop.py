"""Step 3: choose one crop for a whole part. It does not follow the head, so the frames come from one fixed camera."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.media.source import shrunk_size

_CROP_MARGIN = 1.5
"""Room around all positions of the face for hair, neck and shoulders, in face boxes (eyebrows to chin). Set by eye."""
CROP_OUTLIERS = 1.0
"""Percent of the frames at either end that may lie outside of the crop, so that a false detection does not decide
it."""
CROP_MOST_ASPECT = 1.25  # largest aspect ratio of a picture that counts as a head crop already and is kept whole
CROP_LEAST_HEAD_SHARE = 0.7  # least part of such a picture's shorter side that the chosen crop takes


@dataclass(frozen=True)
class Crop:
    """A part of the source picture and the size to which it is shrunk, all in pixels."""

    left: int
    top: int
    crop_width: int
    crop_height: int
    width: int
    height: int

    @property
    def scale(self) -> Float[np.ndarray, " 2"]:
        """Output pixels per source pixel, along x and y."""
        return np.array([self.width / self.crop_width, self.height / self.crop_height])

    def to_output(self, source_pixels: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Convert positions in the source picture to positions in the output."""
        return (source_pixels - np.array([self.left, self.top])) * self.scale

    def apply(self, image: UInt8[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h2 w2 *channels"]:
        """Cut the part out and shrink it (area-averaged)."""
        part = image[self.top : self.top + self.crop_height, self.left : self.left + self.crop_width]
        if (self.crop_width, self.crop_height) == (self.width, self.height):
            return np.ascontiguousarray(part)
        shrunk = cv2.resize(part, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return shrunk.astype(np.uint8, copy=False)


def whole_picture(width: int, height: int, size: int) -> Crop:
    """Return a crop of the whole picture, shrunk so that its longer side has at most `size` pixels."""
    width_out, height_out = shrunk_size(width, height, size)
    return Crop(0, 0, width, height, width_out, height_out)


def choose_crop(boxes: Float[np.ndarray, "t 4"], width: int, height: int, size: int) -> Crop:
    """Return a square inside the picture that holds the head over the whole clip, or the picture if it is a head crop.

    Boxes are left, top, right, bottom of the face as fractions of the picture, NaN where there is none. `size` is the
    largest side of the result in pixels; smaller crops are not enlarged.
    """
    pixels = boxes[np.isfinite(boxes).all(axis=1)] * np.array([width, height, width, height])
    assert len(pixels) > 0
    left, top = np.percentile(pixels[:, :2], CROP_OUTLIERS, axis=0)
    right, bottom = np.percentile(pixels[:, 2:], 100 - CROP_OUTLIERS, axis=0)
    face = float(np.median(np.maximum(pixels[:, 2] - pixels[:, 0], pixels[:, 3] - pixels[:, 1])))
    wanted = max(right - left, bottom - top) + _CROP_MARGIN * face
    shorter, longer = min(width, height), max(width, height)
    if longer <= CROP_MOST_ASPECT * shorter and wanted >= CROP_LEAST_HEAD_SHARE * shorter:
        return whole_picture(width, height, size)
    side = min(round(wanted), shorter)
    return crop_around(np.array([left, top, right, bottom]), side, width, height, size)


def crop_around(box: Float[np.ndarray, " 4"], side: int, width: int, height: int, size: int) -> Crop:
    """Return a square of `side` pixels about a box, inside a picture of that width and height, shrunk to `size`."""
    across, down = min(side, width), min(side, height)
    left = int(np.clip(round((box[0] + box[2] - across) / 2), 0, width - across))
    top = int(np.clip(round((box[1] + box[3] - down) / 2), 0, height - down))
    return Crop(left, top, across, down, min(across, size), min(down, size))
