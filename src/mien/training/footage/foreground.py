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
from jaxtyping import Float, Int, Int32, UInt8

_FOREGROUND_WINDOWS = (1 / 11, 1 / 73)
"""Sides of the windows of both passes, as shares of the picture's longer side: 45 and 7 pixels of 500. Two passes are
of the paper (Forte 2021); the sizes were not varied."""
_FOREGROUND_SOLID = 252  # opacity from which a pixel is person alone, of 255


def foreground_colors(image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture with estimated colours of the person where the matte is soft, and 0 where it is empty.

    Solid pixels keep their colours. Windows are added up exactly, so all processors give the same bytes.
    """
    result = np.zeros_like(image)
    cv2.copyTo(image, (matte > 0).view(np.uint8), result)
    place, colors = soft_colors(image, matte)
    result.reshape(-1, 3)[place] = colors
    return result


def soft_colors(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"]
) -> tuple[Int32[np.ndarray, " k"], UInt8[np.ndarray, "k 3"]]:
    """Return the indices, by rows, of pixels neither empty nor solid, and their colours in `foreground_colors`."""
    left, top, width, height = cv2.boundingRect(matte)
    if width == 0:
        return np.zeros(0, np.int32), np.zeros((0, 3), np.uint8)
    windows = [max(3, 2 * round(share * max(image.shape[:2]) / 2) + 1) for share in _FOREGROUND_WINDOWS]
    # Only the head's box with the first window's margin counts; the picture's own edge stays an edge.
    low = max(0, left - windows[0]), max(0, top - windows[0])
    inside = (slice(low[1], top + height + windows[0]), slice(low[0], left + width + windows[0]))
    filmed, opacity = np.ascontiguousarray(image[inside]), np.ascontiguousarray(matte[inside])
    # An opaque pixel has exactly the filmed colour for its person, and its background has no weight; an empty pixel the
    # other way round. So only the pixels between are estimated.
    place = np.flatnonzero((opacity > 0) & (opacity < 255))
    own, weight = filmed.reshape(-1, 3)[place], opacity.reshape(-1)[place]
    share = (weight * np.float32(1 / 255))[:, None]
    person, background = filmed.copy(), filmed.copy()
    colors = own
    for number, window in enumerate(windows):
        near_person = _mean(person, opacity, window, place)
        near_background = _mean(background, 255 - opacity, window, place)
        rest = own - near_background - share * (near_person - near_background)
        colors = _rounded(near_person + share * rest)
        if number == 0:
            person.reshape(-1, 3)[place] = colors
            background.reshape(-1, 3)[place] = _rounded(near_background + (1 - share) * rest)
    soft = weight < _FOREGROUND_SOLID
    row, column = np.divmod(place[soft], filmed.shape[1])
    return ((row + low[1]) * image.shape[1] + column + low[0]).astype(np.int32), colors[soft]


def _mean(
    colors: UInt8[np.ndarray, "h w 3"],
    weights: UInt8[np.ndarray, "h w"],
    window: int,
    place: Int[np.ndarray, " k"],
) -> Float[np.ndarray, "k 3"]:
    """Weighted mean of the colours around each pixel in `place`; 0 where all weights are 0."""
    # numpy multiplies merged weights of 8 bits eight times as fast as OpenCV.
    weighted = np.multiply(colors, cv2.merge([weights] * 3), dtype=np.uint16)
    # Products and sums are integers, which both types hold exactly, so their order does not matter.
    depth, summed = cv2.CV_32S, (weighted, weights)
    if window * window * 255 * 255 >= 1 << 31:
        depth, summed = cv2.CV_64F, (weighted.astype(np.float32), weights.astype(np.float32))
    total, weight = (
        cv2.boxFilter(values, depth, (window, window), normalize=False, borderType=cv2.BORDER_REFLECT)
        for values in summed
    )
    total, weight = total.reshape(-1, 3)[place], weight.reshape(-1)[place]
    return total.astype(np.float32) / np.maximum(weight, 1).astype(np.float32)[:, None]


def _rounded(colors: Float[np.ndarray, "k 3"]) -> UInt8[np.ndarray, "k 3"]:
    return np.rint(np.clip(colors, 0, 255)).astype(np.uint8)
