"""Heat maps of colour differences, with a legend."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.media.pictures import heat_colors

HOTTEST = 0.15
"""Length of the colour difference (each channel 0..1) that is drawn brightest."""
_DIMMED = 0.35
"""Brightness of pixels that are not compared."""
_MARGIN, _BAR = 8, 8
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def heat_map(difference: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Differences in the colours of `inferno`. Black is no difference, or an unknown one (NaN)."""
    return heat_colors(difference, HOTTEST)


def dimmed(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture in dark grey, as a background."""
    gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    return cv2.cvtColor(cv2.convertScaleAbs(gray, alpha=_DIMMED), cv2.COLOR_GRAY2RGB)


def draw_legend(picture: UInt8[np.ndarray, "h w 3"], top: int) -> None:
    """Draw a colour bar at the left, from no difference to the largest that is shown. Small pictures get none."""
    height, width = picture.shape[:2]
    length = min(120, width // 2 - 2 * _MARGIN)
    if length < 32 or height < top + 64:
        return
    left = 3 * _MARGIN
    bar = np.broadcast_to(np.linspace(0, 255, length), (_BAR, length))
    picture[top : top + _BAR, left : left + length] = heat_colors(bar, 255.0)
    cv2.rectangle(picture, (left - 1, top - 1), (left + length, top + _BAR), _WHITE, 1)
    write_text(picture, "0", (_MARGIN, top + _BAR), 0.4)
    write_text(picture, f"{100 * HOTTEST:.0f} %", (left + length + _MARGIN, top + _BAR), 0.4)


def write_text(picture: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int], size: float = 0.5) -> None:
    """Draw white letters with a black rim. `at` is the left end of their baseline."""
    left, foot = at
    # The rim is the same letters shifted, because thicker letters would also be wider.
    rim = [(left + x, foot + y, _BLACK) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    for x, y, color in (*rim, (left, foot, _WHITE)):
        cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
