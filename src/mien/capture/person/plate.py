"""Step 4, mattes with a clean plate: the person is what differs from the empty scene, near the segmentation mask."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

PLATE_PERSON_LEVEL = 0.9
"""Value of the person mask from which it is trusted away from its border. All numbers of plates were set by eye."""
PLATE_BACKGROUND_LEVEL = 0.05  # value of the person mask up to which it is trusted away from its border
_PLATE_CORE = 1 / 40
"""Width of the border inside the certain person in which the plate decides, as a fraction of the longer side."""
PLATE_HALO = 1 / 12
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
    plate is first shifted and matched to the picture's exposure by the certain background.

    Args:
        image: the picture.
        mask: probability that each part of the picture is a person, 0..1, of any size.
        plate: the same scene without the person.
    """
    height, width = image.shape[:2]
    longer = max(height, width)
    soft = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    near = _grow(soft > PLATE_BACKGROUND_LEVEL, PLATE_HALO * longer)
    core = ~_grow(soft < PLATE_PERSON_LEVEL, _PLATE_CORE * longer)
    background = soft <= PLATE_BACKGROUND_LEVEL if near.all() else ~near
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
    """Return the pixels within `distance` of the mask."""
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
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(prepared[0], prepared[1], window)
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
