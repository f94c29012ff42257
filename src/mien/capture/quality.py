"""Measure a clip: how sharp and how well lit the face is in every frame, and the times between its frames."""

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

_DIRECTIONS = 4  # of detail: across, down and both diagonals. Motion removes it only along itself
MEASURES = _DIRECTIONS + 6  # values that `measure_face` returns
_MIN_BRIGHTNESS = 0.18  # mean level of the face (0..1, sRGB) below which a clip counts as dark
_MAX_CLIPPED = 0.1  # clipped part of the face above which a clip counts as over-exposed
_SKIN_ROWS, _SKIN_COLUMNS = (0.1, 0.8), (0.15, 0.85)  # of the face's box that are mostly skin, as fractions
_CELLS = 8  # along each side of that part. The median over cells leaves out eyes, brows, mouth and glasses
_MAX_CAST = 0.92
"""Level of green or blue, relative to red, from which skin counts as tinted. Skin has up to 0.85 of green and 0.83 of
blue in seven clips, and up to 0.77 and 0.67 in ten drawn people (docs/log.md)."""
_MAX_NOISE = 0.025
"""Noise relative to the face's mean level from which a clip counts as noisy. Seven clips have up to 0.008."""
_LEAST_TINT_CHANGE = 1.2
"""Factor by which the skin's blue, relative to its red, changes over time from which the white balance counts as
drifting. Ten clips have up to 1.12, also where the exposure changes by 2.4."""
_NOISE_KERNEL = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32)
"""Leaves out edges and shading. Its answer to noise of deviation 1 has deviation 6 (Immerkaer, 1996)."""


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

    Brightness, noise (a standard deviation) and colours are 0..1, sRGB. All are NaN if the face is outside the picture.
    """
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(landmarks.min(axis=0)), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(landmarks.max(axis=0)), 0, [width, height]).astype(int)
    if right - left < 2 or bottom - top < 2:
        return np.full(MEASURES, np.nan)
    face = image[top:bottom, left:right]
    clipped = float((face.max(axis=-1) >= 250).mean())
    cells = cv2.resize(_skin(face), (_CELLS, _CELLS), interpolation=cv2.INTER_AREA)
    color = np.median(cells.reshape(-1, 3), axis=0) / 255
    return np.array([*_detail(face), float(face.mean()) / 255, clipped, _noise(face), *color])


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


def relative_quality(measured: Float[np.ndarray, "t m"]) -> FrameQuality:
    """Return the quality of a clip's frames from the results of `measure_face`."""
    values = measured.astype(np.float32)
    detail, others = values[:, :_DIRECTIONS], values[:, _DIRECTIONS:]
    seen = np.isfinite(detail[:, 0])
    usual = np.median(detail[seen], axis=0) if seen.any() else np.ones(_DIRECTIONS, np.float32)
    sharpness = (detail / np.maximum(usual, 1e-6)).min(axis=1, keepdims=True)
    return FrameQuality(sharpness, others[:, :1], others[:, 1:2])


def light_change(brightness: Float[np.ndarray, " n"]) -> float:
    """Return the factor, 1 or more, by which the face's brightness changes, without the extreme twentieths and NaN."""
    known = brightness[brightness > 0]  # NaN compares as not brighter.
    if not len(known):
        return 1.0
    low, high = np.percentile(known, (5, 95))
    return float(high / low)


def is_light_changing(brightness: Float[np.ndarray, " n"]) -> bool:
    """Return whether the brightness of the face, 0..1, says that the light changes. NaN counts nowhere."""
    return light_change(brightness) > _LEAST_LIGHT_CHANGE


def quality_report(name: str, quality: FrameQuality, measured: Float[np.ndarray, "n m"]) -> dict[str, Any]:
    """Return figures for the report from `measure_face` of all pictures, and tell what is wrong with the clip."""
    brightness, clipped, noise = map(_median, (quality.brightness, quality.clipped, measured[:, _DIRECTIONS + 2]))
    color = np.array([_median(channel) for channel in measured[:, -3:].T])
    blurred = np.flatnonzero(quality.blurred.any(axis=1)).tolist()
    changing = max(quality.brightness.T, key=light_change)
    # The rows of rigs are those of several cameras, each with its own colours.
    tints = measured[:, -1] / np.maximum(measured[:, -3], 1e-3) if quality.brightness.shape[1] == 1 else np.ones(1)
    faults = {
        "dark": brightness < _MIN_BRIGHTNESS,
        "overexposed": clipped > _MAX_CLIPPED,
        "noisy": noise > _MAX_NOISE * brightness,
        "changing_light": is_light_changing(changing),
    }
    cast = find_cast(color)
    hints = []
    if faults["dark"]:
        hints.append(
            f"the face is dark (mean level {brightness:.0%}); the avatar will be noisy; record the video again with "
            "more light on the face"
        )
    if faults["overexposed"]:
        hints.append(
            f"the face is over-exposed ({clipped:.0%} of it is white); white parts have no detail; record the video "
            "again with less exposure"
        )
    if cast:
        hints.append(_cast_hint(cast, color))
    if faults["noisy"]:
        hints.append(
            f"the pictures are noisy (a deviation of {255 * noise:.1f} of 255 levels in the skin); fine detail will be "
            "missing; record the video again with more light on the face, and with the camera's gain (ISO) lower"
        )
    if faults["changing_light"]:
        hints.append(_light_hint(changing))
    if light_change(tints) > _LEAST_TINT_CHANGE:
        hints.append(_tint_hint(tints))
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
        "face_brightness_change": round(light_change(changing), 3),
        "skin_tint_change": round(light_change(tints), 3),
        "face_noise": round(noise, 4),
        "face_clipped": round(clipped, 4),
        "skin_color": [round(float(level), 4) for level in color],
        **faults,
        "color_cast": cast or None,
        "hints": hints,
    }


def _median(values: Float[np.ndarray, "*n"]) -> float:
    seen = values[np.isfinite(values)]
    return float(np.median(seen)) if len(seen) else 0.0


def _cast_hint(cast: str, color: Float[np.ndarray, " 3"]) -> str:
    red, green, blue = (round(255 * float(level)) for level in color)
    return (
        f"the skin is {cast} (red {red}, green {green}, blue {blue} of 255), and the avatar's will be; record the "
        "video again in white light with the camera's white balance set on white paper, or correct the colours in "
        "a video program"
    )


def _light_hint(levels: Float[np.ndarray, " t"]) -> str:
    darkest, brightest = int(np.nanargmin(levels)), int(np.nanargmax(levels))
    return (
        f"the light on the face changes by a factor of {light_change(levels):.1f} (mean level {levels[darkest]:.0%} in "
        f"frame {darkest}, {levels[brightest]:.0%} in frame {brightest}); training evens it out with a gain for each "
        "frame, which is less good than steady light; record the video again with the camera's exposure and white "
        "balance locked"
    )


def _tint_hint(tints: Float[np.ndarray, " t"]) -> str:
    least, most = int(np.nanargmin(tints)), int(np.nanargmax(tints))
    return (
        f"the white balance drifts: the skin's blue is {tints[least]:.0%} of its red in frame {least}, and "
        f"{tints[most]:.0%} in frame {most}; add --training.light changing to the training, which learns a gain for "
        "each frame, or record the video again with the camera's white balance locked"
    )


def find_cast(color: Float[np.ndarray, " 3"]) -> str:
    """Return the cast that skin of this colour has: green, blue, or empty for none.

    Skin of everybody has more red than green, and more green than blue or about as much, unless the light or the
    camera's white balance is wrong.
    """
    red, green, blue = (float(level) for level in color)
    strongest = max(green, blue)
    # Channels that are nearly equal are those of black and white film, which has no cast.
    if strongest <= _MAX_CAST * red or max(red, strongest) - min(red, green, blue) < 0.05 * max(red, strongest):
        return ""
    return "green" if green >= blue else "blue"


_RATE_TOLERANCE = 0.01  # relative difference up to which the measured frame rate is taken for the file's nominal one
_RATE_STEADY_RATIO = 1.6
"""Ratio to the median up to which times between frames count for the rate. It is above 1.5, which films at 24 frames a
second have on a grid of 60: they alternate between two and three steps."""

_MAX_INTERVAL_RATIO = 1.5  # of the longest to the median time between frames from which a rate is called variable
_PAUSE_SECONDS, _PAUSE_STEPS = 0.5, 2.5
"""Time between two frames from which it is called a pause: in seconds, and as a multiple of the median, so that a
dropped frame of a slow clip is none."""


def pace_report(name: str, timestamps: Float[np.ndarray, " t"]) -> dict[str, Any]:
    """Return the time between frames for the report, and tell the user if it varies."""
    if len(timestamps) < 3:
        return {"frame_interval_ms": None, "variable_frame_rate": False}
    intervals = 1000 * np.diff(timestamps)
    least, usual, most = (round(float(value), 2) for value in (intervals.min(), np.median(intervals), intervals.max()))
    is_variable = most > _MAX_INTERVAL_RATIO * usual or least * _MAX_INTERVAL_RATIO < usual
    if is_variable:
        say(f"{name}: frames {least:g} to {most:g} ms apart (variable rate); all are kept, each with its own time")
    return {
        "frame_interval_ms": {"least": least, "median": usual, "most": most},
        "variable_frame_rate": is_variable,
        **tell_pauses(name, timestamps),
    }


def is_pause(steps: Float[np.ndarray, " s"]) -> Bool[np.ndarray, " s"]:
    """Tell which times between frames are pauses, in which the video has no frame for long."""
    return steps > max(_PAUSE_SECONDS, _PAUSE_STEPS * float(np.median(steps)))


def tell_pauses(name: str, timestamps: Float[np.ndarray, " t"]) -> dict[str, int]:
    """Tell the user about pauses. Return their number for the report, or nothing if there is none."""
    steps = np.diff(timestamps)
    pauses = np.flatnonzero(is_pause(steps)) if len(steps) else []
    if not len(pauses):
        return {}
    longest = pauses[int(np.argmax(steps[pauses]))]
    which = "a pause" if len(pauses) == 1 else f"{len(pauses)} pauses, the longest"
    say(
        f"{name}: {which} of {steps[longest]:.1f} s without a frame, after {timestamps[longest]:.1f} s; the frame rate "
        "is that of the other frames"
    )
    return {"pauses": len(pauses)}


def frame_rate(timestamps: Float[np.ndarray, " t"], nominal: float) -> float:
    """Return the file's nominal rate, unless its timestamps differ from it (variable rate, dropped frames, pauses).

    Then it is the rate of the frames that are about as far apart as the median, so that pauses and dropped frames do
    not count.
    """
    steps = np.diff(timestamps)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual <= 0:
        return nominal
    steady = (steps <= _RATE_STEADY_RATIO * usual) & (steps * _RATE_STEADY_RATIO >= usual)
    if steady.all():
        measured = float(len(steps) / timestamps[-1])
    else:
        measured = 1 / float(steps[steady].mean() if steady.any() else usual)
    return nominal if abs(measured - nominal) <= _RATE_TOLERANCE * nominal else measured
