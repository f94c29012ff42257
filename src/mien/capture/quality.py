"""Step 4: measure how sharp and how well lit the face is in every frame."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.progress import say

_SIDE = 192
"""Side in pixels to which the face is scaled, so that its distance hardly matters."""
_MIN_SHARPNESS = 0.65
"""Part of the clip's median sharpness below which a frame counts as blurred. A motion by 4 % of the face's width causes
that, or by 5 pixels in a face of 130. Turned heads and closed eyes stay above it (docs/log.md)."""
_DIRECTIONS = 4
"""Directions in which detail is measured: across, down and both diagonals. Motion removes it only along itself."""
MEASURES = _DIRECTIONS + 2
"""Number of values that `measure_face` returns."""
_CLIPPED_LEVEL = 250
"""Level (of 255) from which a channel counts as clipped."""
_MIN_BRIGHTNESS = 0.18
"""Mean level of the face (0..1, sRGB) below which a clip counts as dark."""
_MAX_CLIPPED = 0.1
"""Clipped part of the face above which a clip counts as over-exposed."""


@dataclass(frozen=True, eq=False)
class FrameQuality:
    """Quality of the face in every frame of a capture; NaN where there is none."""

    sharpness: Float[np.ndarray, "t c"]
    """Fine detail of the face in the direction with the least, relative to the clip's median: 1 is usual, 0 is none."""
    brightness: Float[np.ndarray, "t c"]
    """Mean level of the face, 0..1, sRGB."""
    clipped: Float[np.ndarray, "t c"]
    """Part of the face, 0..1, in which a channel is clipped."""

    @property
    def blurred(self) -> Bool[np.ndarray, "t c"]:
        """Frames to leave out of training and of everything else that needs sharp ones."""
        return self.sharpness < _MIN_SHARPNESS  # NaN compares as not blurred


def measure_face(image: UInt8[np.ndarray, "h w 3"], landmarks: Float[np.ndarray, "l 2"]) -> Float[np.ndarray, " m"]:
    """Return detail in each direction (arbitrary units), brightness and clipped part.

    They are NaN if the face lies outside the picture.
    """
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(landmarks.min(axis=0)), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(landmarks.max(axis=0)), 0, [width, height]).astype(int)
    if right - left < 2 or bottom - top < 2:
        return np.full(MEASURES, np.nan)
    face = image[top:bottom, left:right]
    clipped = float((face.max(axis=-1) >= _CLIPPED_LEVEL).mean())
    return np.array([*_detail(face), float(face.mean()) / 255, clipped])


def _detail(face: UInt8[np.ndarray, "h w 3"]) -> list[float]:
    """Return the mean second derivative along each direction, relative to the contrast."""
    grey = cv2.cvtColor(face, cv2.COLOR_RGB2GRAY)
    scale = _SIDE / min(grey.shape)
    grey = cv2.resize(grey, (_SIDE, _SIDE), interpolation=cv2.INTER_LINEAR if scale > 1 else cv2.INTER_AREA)
    # Noise is finer than a face's detail and would count as sharpness, the more so in a small face that is enlarged.
    grey = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(1.0, scale))
    across, down, mixed = (cv2.Sobel(grey, cv2.CV_32F, x, y, ksize=3) for x, y in ((2, 0), (0, 2), (1, 1)))
    diagonal = (across + down) / 2
    contrast = float(grey.std()) + 1
    return [float(np.abs(bend).mean()) / contrast for bend in (across, down, diagonal + mixed, diagonal - mixed)]


def relative_quality(measured: Float[np.ndarray, "t m"]) -> FrameQuality:
    """Return the quality of a clip's frames from the results of `measure_face`."""
    values = measured.astype(np.float32)
    detail, others = values[:, :_DIRECTIONS], values[:, _DIRECTIONS:]
    seen = np.isfinite(detail[:, 0])
    usual = np.median(detail[seen], axis=0) if seen.any() else np.ones(_DIRECTIONS, np.float32)
    sharpness = (detail / np.maximum(usual, 1e-6)).min(axis=1, keepdims=True)
    return FrameQuality(sharpness, others[:, :1], others[:, 1:])


def quality_report(name: str, quality: FrameQuality) -> dict[str, Any]:
    """Return figures for the capture's report, and tell the user what is wrong with the clip."""
    seen = np.isfinite(quality.brightness)
    brightness, clipped = (
        float(np.median(values[seen])) if seen.any() else 0.0 for values in (quality.brightness, quality.clipped)
    )
    blurred = np.flatnonzero(quality.blurred.any(axis=1)).tolist()
    is_dark, is_overexposed = brightness < _MIN_BRIGHTNESS, clipped > _MAX_CLIPPED
    if is_dark:
        say(
            f"warning: {name}: the face is dark (mean level {brightness:.0%}); the avatar will be noisy; record the "
            "video again with more light on the face"
        )
    if is_overexposed:
        say(
            f"warning: {name}: the face is over-exposed ({clipped:.0%} of it is white); white parts have no detail; "
            "record the video again with less exposure"
        )
    if blurred:
        say(
            f"{name}: the face is blurred in {len(blurred)} of {len(quality.sharpness)} frames (report.json names them)"
        )
    return {
        "frames_blurred": len(blurred),
        "blurred_frames": blurred,
        "face_brightness": round(brightness, 4),
        "face_clipped": round(clipped, 4),
        "dark": is_dark,
        "overexposed": is_overexposed,
    }
