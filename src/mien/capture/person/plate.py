"""Step 4, mattes from a known background: a clean plate, or an even green or blue screen.

With a plate, the person is what differs from the empty scene, near the segmentation mask. Before a screen, a pixel is
a mixture of person and screen. Along the screen's own tint, skin and hair have next to nothing, so a pixel's tint says
how much of it is screen (a colour difference key). What tint is left at the person's edges is light from the screen.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.media.display import GROUND

_PLATE_PERSON_LEVEL = 0.9
"""Value of the person mask from which it is trusted away from its border. All numbers of plates were set by eye."""
_PLATE_BACKGROUND_LEVEL = 0.05  # value of the person mask up to which it is trusted away from its border
_PLATE_CORE = 1 / 40
"""Width of the border inside the certain person in which the plate decides, as a fraction of the longer side."""
_PLATE_HALO = 1 / 12
"""Width of the border outside of it, for hair that the mask misses, as a fraction of the longer side."""
_PLATE_LEVELS = (2.5, 7.0)  # colour differences that become 0 and 1, in standard deviations of the background's noise
_PLATE_DOUBT = (2.0, 0.25)
"""Factors on the two levels where the mask says background (raised) and where it says person (lowered)."""
_PLATE_LEAST_NOISE = 0.008  # least standard deviation of the background's noise (colours are 0..1)
_PLATE_SHADOW = 0.35  # weight of a difference that only darkens: it may be the person's shadow on the wall
_PLATE_DARKEST_SHADOW = 0.5  # share of the light that a shadow leaves at least
_PLATE_SHIFT_SIZE = 256  # longest side in pixels of the pictures that tell how the camera has shifted
_PLATE_MOST_SHIFT = 8.0  # largest shift of the camera in pixels at that size
_PLATE_SHIFT_GAIN = 0.9
"""A shift is accepted if it brings the background's difference below this part of its former value."""
_PLATE_GAINS = (0.7, 1.4)  # range of the gain that matches the plate's exposure to the picture's


def plate_matte(
    image: UInt8[np.ndarray, "h w 3"], mask: Float[np.ndarray, "m m"], plate: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the opacity of the person, 255 = person.

    The mask decides well inside the person and far away from it. In between, the difference to the plate decides. The
    plate, which is the same scene without the person, is first shifted and matched to the picture's exposure by the
    certain background. The mask is the probability of a person, 0..1, of any size.
    """
    height, width = image.shape[:2]
    longer = max(height, width)
    soft = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    near = _grow(soft > _PLATE_BACKGROUND_LEVEL, _PLATE_HALO * longer)
    core = ~_grow(soft < _PLATE_PERSON_LEVEL, _PLATE_CORE * longer)
    background = soft <= _PLATE_BACKGROUND_LEVEL if near.all() else ~near
    picture, scene = image.astype(np.float32) / 255, plate.astype(np.float32) / 255
    noise = _PLATE_LEAST_NOISE
    if background.any():
        scene = _match(picture, scene, background)
        noise = max(noise, float(np.sqrt(np.mean(np.square(_difference(picture, scene)[background])))))
    # Where the mask says person, a small difference is enough; where it says background, a larger one is needed.
    levels = noise * (_PLATE_DOUBT[0] + (_PLATE_DOUBT[1] - _PLATE_DOUBT[0]) * np.clip(soft, 0, 1))
    low, high = _PLATE_LEVELS
    alpha = np.clip((_difference(picture, scene) / levels - low) / (high - low), 0, 1)
    alpha = np.where(core, 1.0, np.where(near, alpha, 0.0))
    return np.rint(alpha * 255).astype(np.uint8)


def _grow(mask: Bool[np.ndarray, "h w"], distance: float) -> Bool[np.ndarray, "h w"]:
    if not mask.any():
        return mask
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) <= distance


def _match(picture: np.ndarray, scene: np.ndarray, background: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Return the scene, shifted and brightened to match the picture's background."""
    scene = _expose(picture, scene, background)
    shift = _shift(picture, scene, background)
    if np.abs(shift).max() < 0.05:
        return scene
    height, width = scene.shape[:2]
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(scene, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    before, after = (float(np.abs(picture - candidate)[background].mean()) for candidate in (scene, moved))
    return _expose(picture, moved, background) if after < _PLATE_SHIFT_GAIN * before else scene


def _expose(picture: np.ndarray, scene: np.ndarray, background: np.ndarray) -> np.ndarray:
    gain = picture[background].mean(axis=0) / np.maximum(scene[background].mean(axis=0), 1e-3)
    return scene * np.clip(gain, *_PLATE_GAINS).astype(np.float32)


def _shift(picture: np.ndarray, scene: np.ndarray, background: np.ndarray) -> Float[np.ndarray, " 2"]:
    """Return the shift in pixels along x and y from the scene to the picture's background."""
    height, width = background.shape
    scale = min(1.0, _PLATE_SHIFT_SIZE / max(height, width))
    size = (max(8, round(width * scale)), max(8, round(height * scale)))
    known = cv2.resize(background.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    # Both get the same grey hole where the person is, so that nothing in it favours any shift.
    prepared = []
    for image in (scene, picture):
        gray = cv2.resize(image.mean(axis=-1), size, interpolation=cv2.INTER_AREA)
        gray = gray - cv2.GaussianBlur(gray, (0, 0), 4.0)
        prepared.append((gray * known).astype(np.float32))
    (x, y), _ = cv2.phaseCorrelate(prepared[0], prepared[1], cv2.createHanningWindow(size, cv2.CV_32F))
    if max(abs(x), abs(y)) > _PLATE_MOST_SHIFT:
        return np.zeros(2)
    return np.array([x * width / size[0], y * height / size[1]])


def _difference(picture: np.ndarray, scene: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Return the slightly smoothed colour difference. Darkening, as by a shadow, counts less."""
    shade = (picture * scene).sum(axis=-1) / np.maximum(np.square(scene).sum(axis=-1), 1e-4)
    shade = np.clip(shade, _PLATE_DARKEST_SHADOW, 1)[..., None]
    other = np.abs(picture - shade * scene).max(axis=-1)
    darkening = (1 - shade[..., 0]) * scene.max(axis=-1)
    return cv2.blur((other + _PLATE_SHADOW * darkening).astype(np.float32), (3, 3))


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


def screen_of(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 3"] | None:
    """Return the colour of the screen around the person (0..1, sRGB), or None if there is none.

    A screen is most of the picture's border, in one saturated tint that is not red, as skin is, of any brightness.
    """
    height, width = image.shape[:2]
    edge, low = max(1, round(0.03 * min(height, width))), round(0.6 * height)  # Shoulders are below.
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
    """Return the opacity of the person before a screen of that colour (`screen_of`), 255 = person.

    The mask is the probability of a person, 0..1, of any size. Far from the person, things that have not the screen's
    colour do not count. Inside, a trace of its tint makes no hole.
    """
    height, width = image.shape[:2]
    soft = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    # How much of the screen's tint each pixel has: 1 for the screen, 0 or less for skin and hair.
    tint = _tint(screen)
    share = (image.astype(np.float32) / 255) @ tint / np.maximum(_local_screen(image, screen) @ tint, 1e-3)
    low, high = _SCREEN_LEVELS
    alpha = np.clip((1 - share - low) / (high - low), 0, 1)
    inside = (soft > _PLATE_PERSON_LEVEL) & (share < _SCREEN_INSIDE_MOST)
    bare = cv2.distanceTransform((share < _SCREEN_INSIDE_MOST).astype(np.uint8), cv2.DIST_L2, 3)
    alpha[inside & (bare > _SCREEN_SPILL * max(height, width))] = 1
    away = (soft < _PLATE_BACKGROUND_LEVEL).astype(np.uint8)
    side = 2 * round(_PLATE_HALO * max(height, width)) + 1
    alpha[cv2.erode(away, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0] = 0
    return np.rint(alpha * 255).astype(np.uint8)


def without_screen(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"], screen: Float[np.ndarray, " 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the person over an even grey, without the screen's tint at the edges. Inside, colours stay."""
    alpha = matte[..., None].astype(np.float32) / 255
    behind = _local_screen(image, screen)
    front = np.clip(image / np.float32(255) - (1 - alpha) * behind, 0, alpha)
    tint = _tint(screen)
    inside = cv2.distanceTransform((matte > 127).astype(np.uint8), cv2.DIST_L2, 3)
    near = np.clip(2 - inside / (_SCREEN_SPILL * max(matte.shape)), 0, 1)
    front -= (near * np.maximum(front @ tint, 0))[..., None] * (tint / (tint @ tint))
    return np.rint(np.clip(255 * front + (1 - alpha) * GROUND, 0, 255)).astype(np.uint8)


def _tint(color: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return (color - color.mean()).astype(np.float32)


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
