"""Colours of the person alone at soft edges of the matte.

A pixel at a soft edge, such as a strand of hair, holds some of the filmed background. When it is composited over
another background, it keeps this share, and an avatar learns it: light slivers on the edges of hair and neck, which
show from the side and over dark pages. The colours are estimated by blur fusion (Forte, "Approximate Fast Foreground
Colour Estimation", ICIP 2021): colours of person and background are averaged near each pixel, and the rest, by which
the pixel's own colour differs from their mixture, is divided between both. A second pass with a small window sharpens
the result of the first.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.training.footage.constants import FOOTAGE


def foreground_colors(image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture with estimated colours of the person where the matte is soft, and 0 where it is empty.

    Solid pixels keep their colours. Windows are added up exactly, so all processors give the same bytes.

    Args:
        image: The filmed picture, sRGB.
        matte: Opacity of the person in it, not cut at the neck.
    """
    left, top, width, height = cv2.boundingRect(matte)
    result = np.zeros_like(image)
    if width == 0:
        return result
    windows = [max(3, 2 * round(share * max(image.shape[:2]) / 2) + 1) for share in FOOTAGE.foreground_windows]
    # Only the head's box with the first window's margin counts; the picture's own edge stays an edge.
    low, high = (max(0, left - windows[0]), max(0, top - windows[0])), (left + width, top + height)
    inside = (slice(low[1], high[1] + windows[0]), slice(low[0], high[0] + windows[0]))
    filmed, opacity = np.ascontiguousarray(image[inside]), np.ascontiguousarray(matte[inside])
    share = (opacity * np.float32(1 / 255))[..., None]
    person, background = filmed, filmed
    for number, window in enumerate(windows):
        near_person, near_background = _mean(person, opacity, window), _mean(background, 255 - opacity, window)
        rest = filmed - near_background - share * (near_person - near_background)
        person = _rounded(near_person + share * rest)
        if number == 0:
            background = _rounded(near_background + (1 - share) * rest)
    cv2.copyTo(filmed, (opacity >= FOOTAGE.foreground_solid).view(np.uint8), person)
    cv2.copyTo(person, (opacity > 0).view(np.uint8), result[inside])
    return result


def soft_pixels(matte: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose colours `foreground_colors` estimates: neither empty nor solid."""
    return (matte > 0) & (matte < FOOTAGE.foreground_solid)


def _mean(
    colors: UInt8[np.ndarray, "h w 3"], weights: UInt8[np.ndarray, "h w"], window: int
) -> Float[np.ndarray, "h w 3"]:
    """Weighted mean of the colours around each pixel; 0 where all weights are 0."""
    weighted = cv2.multiply(colors, cv2.merge([weights] * 3), dtype=cv2.CV_16U)
    # Products and sums are integers, which both types hold exactly, so their order does not matter.
    depth, summed = cv2.CV_32S, (weighted, weights)
    if window * window * 255 * 255 >= 1 << 31:
        depth, summed = cv2.CV_64F, (weighted.astype(np.float32), weights.astype(np.float32))
    total, weight = (
        cv2.boxFilter(values, depth, (window, window), normalize=False, borderType=cv2.BORDER_REFLECT)
        for values in summed
    )
    return cv2.divide(total.astype(np.float32), cv2.merge([np.maximum(weight, 1).astype(np.float32)] * 3))


def _rounded(colors: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.rint(np.clip(colors, 0, 255)).astype(np.uint8)
