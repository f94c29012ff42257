"""Step 1: alpha that a source brings. It is the matte, and what lies under it counts nowhere."""

import numpy as np
from jaxtyping import UInt8

GROUND = 128
"""Grey level that replaces what is transparent. Faces are found before it, and soft edges are cleaned of it as of any
even background."""
_TRANSPARENT = 128
"""Alpha below which a pixel is more transparent than not."""
_NOISE, _FEW = 8, 0.01
"""Levels by which compression lifts premultiplied colours above their alpha, and the share of pixels beyond that."""


def over_ground(colors: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture with alpha over an even grey.

    Colours that are nowhere brighter than their alpha are taken for premultiplied ones: some programs write those, and
    OpenCV makes them of TIFF files.
    """
    if alpha.min() == 255:
        return colors
    soft = (alpha > 0) & (alpha < 255)
    brighter = colors[soft].max(axis=-1, initial=0) > alpha[soft].astype(np.int16) + _NOISE
    share = alpha[..., None].astype(np.float32) / 255
    front = colors * (share > 0 if soft.any() and brighter.mean() < _FEW else share)
    return np.rint(np.minimum(front + (1 - share) * GROUND, 255)).astype(np.uint8)


def as_matte(alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"] | None:
    """Return the alpha, or None if it is opaque everywhere, as it is in many files that have a channel for it."""
    return np.ascontiguousarray(alpha) if alpha.min() < _TRANSPARENT else None
