"""Step 4: measure how sharp and how well lit the face is in every frame."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mien.machine.progress import say

_SHARPNESS_SIDE = 192
"""Side in pixels to which the face is scaled to measure its sharpness, so that its distance hardly matters. Measured:
with 128, a blur of 8 % of the face's width is missed (log; the measure changed as well)."""
_LEAST_SHARPNESS = 0.65
"""Part of the clip's median sharpness below which a frame counts as blurred and is not trained on. Measured: a motion
by 4 % of the face's width causes that, or by 5 pixels in a face of 130. Turned heads and closed eyes stay above it
(log)."""
_LEAST_LIGHT_CHANGE = 1.35
"""Factor by which the face's brightness changes over time from which the light counts as changing, and training learns
a gain for each frame. Measured: seven clips in steady light have up to 1.17 (log)."""

_DIRECTIONS = 4
"""Directions in which detail is measured: across, down and both diagonals. Motion removes it only along itself."""
_CHANNELS = 3
MEASURES = _DIRECTIONS + 3 + _CHANNELS
"""Number of values that `measure_face` returns."""
_CLIPPED_LEVEL = 250
"""Level (of 255) from which a channel counts as clipped."""
_MIN_BRIGHTNESS = 0.18
"""Mean level of the face (0..1, sRGB) below which a clip counts as dark."""
_MAX_CLIPPED = 0.1
"""Clipped part of the face above which a clip counts as over-exposed."""
_SKIN_ROWS, _SKIN_COLUMNS = (0.1, 0.8), (0.15, 0.85)
"""Rows and columns of the face's box that are mostly skin, as fractions."""
_CELLS = 8
"""Cells along each side of that part. The median over cells leaves out eyes, brows, mouth and glasses."""
_MAX_CAST = 0.92
"""Level of green or blue, relative to red, from which skin counts as tinted. Skin has up to 0.85 of green and 0.83 of
blue in seven clips, and up to 0.77 and 0.67 in ten drawn people (docs/log.md)."""
_MAX_NOISE = 0.025
"""Noise relative to the face's mean level from which a clip counts as noisy. Seven clips have up to 0.008."""
_LEAST_TINT_CHANGE = 1.2
"""Factor by which the skin's blue, relative to its red, changes over time from which the white balance counts as
drifting. Ten clips have up to 1.12, also where the exposure changes by 2.4."""
_LIGHT_RANGE = (5, 95)
"""Percentiles of the face's brightness over time that are compared, so that single frames do not count."""
_NOISE_KERNEL = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
"""Leaves out edges and shading. Its answer to noise of deviation 1 has deviation 6 (Immerkaer, 1996)."""
_MIN_COLOR = 0.05
"""Relative difference of the channels below which a picture counts as grey: black and white film has no cast."""


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
        return self.sharpness < _LEAST_SHARPNESS  # NaN compares as not blurred


def measure_face(image: UInt8[np.ndarray, "h w 3"], landmarks: Float[np.ndarray, "l 2"]) -> Float[np.ndarray, " m"]:
    """Return detail in each direction (arbitrary units), brightness, clipped part, noise, and the skin's colour.

    Brightness, noise (a standard deviation) and colours are 0..1, sRGB.

    They are NaN if the face lies outside the picture.
    """
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(landmarks.min(axis=0)), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(landmarks.max(axis=0)), 0, [width, height]).astype(int)
    if right - left < 2 or bottom - top < 2:
        return np.full(MEASURES, np.nan)
    face = image[top:bottom, left:right]
    clipped = float((face.max(axis=-1) >= _CLIPPED_LEVEL).mean())
    return np.array([*_detail(face), float(face.mean()) / 255, clipped, _noise(face), *_skin_color(face)])


def _noise(face: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the standard deviation of what no edge or shading explains, in the median cell of the skin's part."""
    gray = cv2.cvtColor(_skin(face), cv2.COLOR_RGB2GRAY).astype(np.float32)
    rough = np.abs(cv2.filter2D(gray, cv2.CV_32F, _NOISE_KERNEL))
    cells = cv2.resize(rough, (_CELLS, _CELLS), interpolation=cv2.INTER_AREA)
    return float(np.median(cells)) * math.sqrt(math.pi / 2) / 6 / 255


def _detail(face: UInt8[np.ndarray, "h w 3"]) -> list[float]:
    """Return the mean second derivative along each direction, relative to the contrast."""
    gray = cv2.cvtColor(face, cv2.COLOR_RGB2GRAY)
    side = _SHARPNESS_SIDE
    scale = side / min(gray.shape)
    gray = cv2.resize(gray, (side, side), interpolation=cv2.INTER_LINEAR if scale > 1 else cv2.INTER_AREA)
    # Noise is finer than a face's detail and would count as sharpness, the more so in a small face that is enlarged.
    gray = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), max(1.0, scale))
    across, down, mixed = (cv2.Sobel(gray, cv2.CV_32F, x, y, ksize=3) for x, y in ((2, 0), (0, 2), (1, 1)))
    diagonal = (across + down) / 2
    contrast = float(gray.std()) + 1
    return [float(np.abs(bend).mean()) / contrast for bend in (across, down, diagonal + mixed, diagonal - mixed)]


def _skin(face: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "p q 3"]:
    height, width = face.shape[:2]
    top, bottom = (int(part * height) for part in _SKIN_ROWS)
    left, right = (int(part * width) for part in _SKIN_COLUMNS)
    return face[top : max(bottom, top + 1), left : max(right, left + 1)]


def _skin_color(face: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, " 3"]:
    cells = cv2.resize(_skin(face), (_CELLS, _CELLS), interpolation=cv2.INTER_AREA)
    return np.median(cells.reshape(-1, _CHANNELS), axis=0) / 255


def relative_quality(measured: Float[np.ndarray, "t m"]) -> FrameQuality:
    """Return the quality of a clip's frames from the results of `measure_face`."""
    values = measured.astype(np.float32)
    detail, others = values[:, :_DIRECTIONS], values[:, _DIRECTIONS:]
    seen = np.isfinite(detail[:, 0])
    usual = np.median(detail[seen], axis=0) if seen.any() else np.ones(_DIRECTIONS, np.float32)
    sharpness = (detail / np.maximum(usual, 1e-6)).min(axis=1, keepdims=True)
    return FrameQuality(sharpness, others[:, :1], others[:, 1:2])


def light_change(brightness: Float[np.ndarray, " n"]) -> float:
    """Return by what factor the brightness of the face changes over pictures, 1 or more. NaN counts nowhere.

    The darkest and the brightest twentieth of the pictures do not count.
    """
    known = brightness[brightness > 0]  # NaN compares as not brighter.
    if not len(known):
        return 1.0
    low, high = np.percentile(known, _LIGHT_RANGE)
    return float(high / low)


def is_light_changing(brightness: Float[np.ndarray, " n"]) -> bool:
    """Return whether the brightness of the face, 0..1, says that the light changes. NaN counts nowhere."""
    return light_change(brightness) > _LEAST_LIGHT_CHANGE


def quality_report(name: str, quality: FrameQuality, measured: Float[np.ndarray, "n m"]) -> dict[str, Any]:
    """Return figures for the capture's report, and tell the user what is wrong with the clip.

    Args:
        name: name of the capture, for messages.
        quality: quality of all frames.
        measured: results of `measure_face` for all pictures.
    """
    seen = np.isfinite(quality.brightness)
    brightness, clipped = (
        float(np.median(values[seen])) if seen.any() else 0.0 for values in (quality.brightness, quality.clipped)
    )
    blurred = np.flatnonzero(quality.blurred.any(axis=1)).tolist()
    known = measured[np.isfinite(measured).all(axis=1)]
    color = np.median(known[:, -_CHANNELS:], axis=0) if len(known) else np.zeros(_CHANNELS)
    noise = float(np.median(known[:, _DIRECTIONS + 2])) if len(known) else 0.0
    cast = find_cast(color)
    is_dark, is_overexposed = brightness < _MIN_BRIGHTNESS, clipped > _MAX_CLIPPED
    is_noisy = noise > _MAX_NOISE * brightness
    changing = max(quality.brightness.T, key=light_change)
    change = light_change(changing)
    # The rows of rigs are those of several cameras, each with its own colours.
    tints = measured[:, -1] / np.maximum(measured[:, -3], 1e-3) if quality.brightness.shape[1] == 1 else np.ones(1)
    hints = _hints(
        brightness if is_dark else None,
        clipped if is_overexposed else None,
        cast,
        color,
        noise if is_noisy else None,
        changing if is_light_changing(changing) else None,
        tints if light_change(tints) > _LEAST_TINT_CHANGE else None,
    )
    for hint in hints:
        say(f"warning: {name}: {hint}")
    if blurred:
        say(
            f"{name}: the face is blurred in {len(blurred)} of {len(quality.sharpness)} frames (report.json names them)"
        )
    return {
        "frames_blurred": len(blurred),
        "blurred_frames": blurred,
        "face_brightness": round(brightness, 4),
        "face_brightness_change": round(change, 3),
        "skin_tint_change": round(light_change(tints), 3),
        "face_noise": round(noise, 4),
        "face_clipped": round(clipped, 4),
        "skin_color": [round(float(level), 4) for level in color],
        "dark": is_dark,
        "overexposed": is_overexposed,
        "noisy": is_noisy,
        "changing_light": is_light_changing(changing),
        "color_cast": cast or None,
        "hints": hints,
    }


def find_cast(color: Float[np.ndarray, " 3"]) -> str:
    """Return the cast that skin of this colour has: green, blue, or empty for none.

    Skin of everybody has more red than green, and more green than blue or about as much, unless the light or the
    camera's white balance is wrong.
    """
    red, green, blue = (float(level) for level in color)
    strongest = max(green, blue)
    if strongest <= _MAX_CAST * red or max(red, strongest) - min(red, green, blue) < _MIN_COLOR * max(red, strongest):
        return ""
    return "green" if green >= blue else "blue"


def _hints(
    dark: float | None,
    white: float | None,
    cast: str,
    color: Float[np.ndarray, " 3"],
    noise: float | None,
    changing: Float[np.ndarray, " t"] | None,
    drifting: Float[np.ndarray, " t"] | None,
) -> list[str]:
    """Return a line with a remedy for each fault.

    The faults are a dark face's level, an over-exposed face's white part, a cast, the noise, and for each frame the
    brightness where it changes and the ratio of blue to red where that drifts.
    """
    hints = []
    if dark is not None:
        hints.append(
            f"the face is dark (mean level {dark:.0%}); the avatar will be noisy; record the video again with more "
            "light on the face"
        )
    if white is not None:
        hints.append(
            f"the face is over-exposed ({white:.0%} of it is white); white parts have no detail; record the video "
            "again with less exposure"
        )
    if cast:
        red, green, blue = (round(255 * float(level)) for level in color)
        hints.append(
            f"the skin is {cast} (red {red}, green {green}, blue {blue} of 255), and the avatar's will be; record the "
            "video again in white light with the camera's white balance set on white paper, or correct the colours in "
            "a video program"
        )
    if noise is not None:
        hints.append(
            f"the pictures are noisy (a deviation of {255 * noise:.1f} of 255 levels in the skin); fine detail will be "
            "missing; record the video again with more light on the face, and with the camera's gain (ISO) lower"
        )
    if changing is not None:
        darkest, brightest = int(np.nanargmin(changing)), int(np.nanargmax(changing))
        hints.append(
            f"the light on the face changes by a factor of {light_change(changing):.1f} (mean level "
            f"{changing[darkest]:.0%} in frame {darkest}, {changing[brightest]:.0%} in frame {brightest}); training "
            "evens it out with a gain for each frame, which is less good than steady light; record the video again "
            "with the camera's exposure and white balance locked"
        )
    if drifting is not None:
        least, most = int(np.nanargmin(drifting)), int(np.nanargmax(drifting))
        hints.append(
            f"the white balance drifts: the skin's blue is {drifting[least]:.0%} of its red in frame {least}, and "
            f"{drifting[most]:.0%} in frame {most}; add --training.light changing to the training, which learns a gain "
            "for each frame, or record the video again with the camera's white balance locked"
        )
    return hints
