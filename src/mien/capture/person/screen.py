"""Step 4, green and blue screens: an even, saturated background gives the matte, and its light on the person goes.

A pixel is a mixture of person and screen. Along the screen's own tint, skin and hair have next to nothing, so a pixel's
tint says how much of it is screen (a colour difference key). What tint is left at the person's edges is light from the
screen.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.person.plate import PLATE_BACKGROUND_LEVEL, PLATE_HALO, PLATE_PERSON_LEVEL
from mien.media.alpha import GROUND

_SCREEN_LEAST_LEVEL = 0.2  # least level of a screen's brightest channel, 0..1
_SCREEN_MOST_RED = 0.7  # most red of a screen, relative to its brightest channel. Skin has most of red
_SCREEN_LEAST_SATURATION = 0.45  # least difference of a screen's channels, relative to the brightest
_SCREEN_MOST_DIFFERENCE = 0.15
"""Largest difference of a screen's channels, relative to the brightest one, from their median."""
_SCREEN_LEAST_SHARE = 0.8  # part of the border that has the screen's tint at least
_SCREEN_LEVELS = (0.08, 0.9)
"""Shares of what is not screen that become 0 and 1. Skin at the edges has some of the screen's light."""
_SCREEN_INSIDE_MOST = 0.6
"""Share of screen up to which a pixel inside the person's mask is opaque: green eyes and stripes make no holes."""
_SCREEN_SPILL = 1 / 40
"""Width of the edge that loses the screen's light, as a fraction of the longer side; at twice that nothing does."""
_SCREEN_WINDOW = 1 / 6  # side of the window in which the screen's light is averaged, as a fraction of the longer side

_BORDER = 0.03
"""Width of the border that is looked at, above and on both sides, as a fraction of the shorter side."""
_BORDER_HEIGHT = 0.6
"""Part of the height down to which the sides are looked at. Shoulders are below."""


def screen_of(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return the colour of the screen around the person (0..1, sRGB), or None if there is none.

    A screen is most of the picture's border, in one saturated tint that is not red, as skin is.
    Its brightness may vary.
    """
    height, width = image.shape[:2]
    edge, low = max(1, round(_BORDER * min(height, width))), round(_BORDER_HEIGHT * height)
    sides = (image[:edge], image[:low, :edge], image[:low, -edge:])
    border = np.concatenate([side.reshape(-1, 3) for side in sides]).astype(np.float32) / 255
    color = np.median(border, axis=0)
    brightest = float(color.max())
    if brightest < _SCREEN_LEAST_LEVEL or color[0] > _SCREEN_MOST_RED * brightest:
        return None
    if brightest - color.min() < _SCREEN_LEAST_SATURATION * brightest:
        return None
    tints = border / np.maximum(border.max(axis=1, keepdims=True), 1e-3)
    even = np.abs(tints - color / brightest).max(axis=1) < _SCREEN_MOST_DIFFERENCE
    even &= border.max(axis=1) > brightest / 2
    return color.astype(np.float64) if even.mean() > _SCREEN_LEAST_SHARE else None


def screen_matte(
    image: UInt8[np.ndarray, "h w 3"], mask: Float[np.ndarray, "m m"], screen: Float[np.ndarray, " 3"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the opacity of the person before a screen, 255 = person.

    Args:
        image: the picture.
        mask: probability that each part of the picture is a person, 0..1, of any size. Far from the person, things that
            have not the screen's colour do not count. Inside, a trace of its tint makes no
            hole.
        screen: the screen's colour (`screen_of`).
    """
    height, width = image.shape[:2]
    soft = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    share = _share_of_screen(image, screen)
    low, high = _SCREEN_LEVELS
    alpha = np.clip((1 - share - low) / (high - low), 0, 1)
    inside = (soft > PLATE_PERSON_LEVEL) & (share < _SCREEN_INSIDE_MOST)
    bare = cv2.distanceTransform((share < _SCREEN_INSIDE_MOST).astype(np.uint8), cv2.DIST_L2, 3)
    alpha[inside & (bare > _SCREEN_SPILL * max(height, width))] = 1
    away = (soft < PLATE_BACKGROUND_LEVEL).astype(np.uint8)
    alpha[cv2.erode(away, _disc(PLATE_HALO * max(height, width))) > 0] = 0
    return np.rint(alpha * 255).astype(np.uint8)


def without_screen(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"], screen: Float[np.ndarray, " 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the person over an even grey, without the screen's tint at the edges.

    Inside, colours stay: green eyes and blue shirts are no light from the screen.
    """
    alpha = matte[..., None].astype(np.float32) / 255
    behind = _local_screen(image, screen)
    front = np.clip(image / np.float32(255) - (1 - alpha) * behind, 0, alpha)
    tint = _tint(screen)
    inside = cv2.distanceTransform((matte > 127).astype(np.uint8), cv2.DIST_L2, 3)
    near = np.clip(2 - inside / (_SCREEN_SPILL * max(matte.shape)), 0, 1)
    front -= (near * np.maximum(front @ tint, 0))[..., None] * (tint / (tint @ tint))
    return np.rint(np.clip(255 * front + (1 - alpha) * GROUND, 0, 255)).astype(np.uint8)


def _tint(color: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return what a colour has beyond grey."""
    return (color - color.mean()).astype(np.float32)


def _share_of_screen(image: np.ndarray, screen: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Return how much of the screen's tint each pixel has: 1 for the screen, 0 or less for skin and hair."""
    tint = _tint(screen)
    return (image.astype(np.float32) / 255) @ tint / np.maximum(_local_screen(image, screen) @ tint, 1e-3)


def _local_screen(image: np.ndarray, screen: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Return the screen's colour at each pixel, as what is seen of it nearby, since lamps light it unevenly."""
    height, width = image.shape[:2]
    small = max(1, width // 4), max(1, height // 4)
    picture = cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    tints = picture / np.maximum(picture.max(axis=-1, keepdims=True), 1e-3)
    bare = np.abs(tints - (screen / screen.max()).astype(np.float32)).max(axis=-1) < _SCREEN_MOST_DIFFERENCE
    bare &= picture.max(axis=-1) > screen.max() / 2
    bare = cv2.erode(bare.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    window = [2 * round(_SCREEN_WINDOW * max(small) / 2) + 1] * 2
    total = cv2.blur(picture * bare[..., None], window, borderType=cv2.BORDER_REFLECT)
    weight = cv2.blur(bare, window, borderType=cv2.BORDER_REFLECT)[..., None]
    # A little of the whole screen's colour fills in where none is near.
    nearby = (total + 0.01 * screen.astype(np.float32)) / (weight + np.float32(0.01))
    return cv2.resize(nearby, (width, height), interpolation=cv2.INTER_LINEAR)


def _disc(radius: float) -> np.ndarray:
    side = 2 * round(radius) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
