"""Step 4, green and blue screens: an even, saturated background gives the matte, and its light on the person goes.

A pixel is a mixture of person and screen. Along the screen's own tint, skin and hair have next to nothing, so a pixel's
tint says how much of it is screen (a colour difference key). What tint is left at the person's edges is light from the
screen.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mien.capture.constants import CAPTURE
from mien.capture.person.alpha import GROUND

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
    if brightest < CAPTURE.screen_least_level or color[0] > CAPTURE.screen_most_red * brightest:
        return None
    if brightest - color.min() < CAPTURE.screen_least_saturation * brightest:
        return None
    tints = border / np.maximum(border.max(axis=1, keepdims=True), 1e-3)
    even = np.abs(tints - color / brightest).max(axis=1) < CAPTURE.screen_most_difference
    even &= border.max(axis=1) > brightest / 2
    return color.astype(np.float64) if even.mean() > CAPTURE.screen_least_share else None


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
    low, high = CAPTURE.screen_levels
    alpha = np.clip((1 - share - low) / (high - low), 0, 1)
    inside = (soft > CAPTURE.plate_person_level) & (share < CAPTURE.screen_inside_most)
    bare = cv2.distanceTransform((share < CAPTURE.screen_inside_most).astype(np.uint8), cv2.DIST_L2, 3)
    alpha[inside & (bare > CAPTURE.screen_spill * max(height, width))] = 1
    away = (soft < CAPTURE.plate_background_level).astype(np.uint8)
    alpha[cv2.erode(away, _disc(CAPTURE.plate_halo * max(height, width))) > 0] = 0
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
    near = np.clip(2 - inside / (CAPTURE.screen_spill * max(matte.shape)), 0, 1)
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
    bare = np.abs(tints - (screen / screen.max()).astype(np.float32)).max(axis=-1) < CAPTURE.screen_most_difference
    bare &= picture.max(axis=-1) > screen.max() / 2
    bare = cv2.erode(bare.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    window = [2 * round(CAPTURE.screen_window * max(small) / 2) + 1] * 2
    total = cv2.blur(picture * bare[..., None], window, borderType=cv2.BORDER_REFLECT)
    weight = cv2.blur(bare, window, borderType=cv2.BORDER_REFLECT)[..., None]
    # A little of the whole screen's colour fills in where none is near.
    nearby = (total + 0.01 * screen.astype(np.float32)) / (weight + np.float32(0.01))
    return cv2.resize(nearby, (width, height), interpolation=cv2.INTER_LINEAR)


def _disc(radius: float) -> np.ndarray:
    side = 2 * round(radius) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
