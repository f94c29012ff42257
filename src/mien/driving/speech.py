"""Motion from the loudness of a voice: the jaw and the mouth open with the sound, and the head lives meanwhile.

It knows no words, so it makes mouths that fit the rhythm of speech, not its sounds. Loudness is in dB above the noise
floor of the file, because the ear hears it so and because recordings differ. Where most energy is at high frequencies
(s, sh, i), the mouth is wide and less open; where it is at low ones (o, u), the lips are rounded.
"""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mien.capture.sound import RATE, read_sound
from mien.driving.motion import ARKIT_NAMES, Motion
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

FPS = 30.0
"""Moments a second of the motion."""
_WINDOW = 0.04
"""Length of the pieces of sound that are measured, in seconds."""
_SMOOTHING = 0.035
"""Standard deviation of the smoothing over time, in seconds. It is even before and after, so there is no lag."""
_FLOOR_SHARE, _LOUD_SHARE = 10, 95
"""Percentiles of the loudness that are the noise floor and a loud voice."""
_LEAST_RANGE, _MOST_RANGE = 25.0, 45.0
"""Bounds of the distance from the noise floor to a loud voice, in dB."""
_GATE = 0.15
"""Share of this distance above the noise floor that still counts as silence."""
_SILENCE = -55.0
"""Loudness of silence in dB, where 0 is the loudest possible. Files that are never louder do not move the mouth."""
_SHAPE = 1.6
"""Exponent from loudness to opening: between loudness in dB (1) and pressure (about 2)."""
_SPLIT_LOW, _SPLIT_HIGH = 700.0, 2500.0
"""Frequencies in Hz below which sound is low, and above which it is high."""
_JAW, _LOWER_LIP, _UPPER_LIP, _FUNNEL, _STRETCH = 0.55, 0.25, 0.12, 0.35, 0.3
"""Largest coefficients."""
_LESS_JAW = 0.6
"""Share of the jaw's opening that high sounds take away."""
_SWAY = (0.012, 0.02, 0.008)
"""Sizes of the head's slow waves about x, y and z, in radians."""
_BETWEEN, _CLOSING, _OPENING = 3.5, 0.08, 0.17
"""Mean time between blinks, and the times to close and to open, in seconds: as in the exported page."""


def read_speech(path: Path) -> Motion:
    """The motion for a file with sound. The same file gives the same motion.

    Raises:
        UserError: the file is missing, has no sound, or is longer than an hour.
    """
    return motion_of_sound(read_sound(path))


def motion_of_sound(samples: Float32[np.ndarray, " n"]) -> Motion:
    """The motion for a sound with one channel and `mien.capture.sound.RATE` samples a second, -1..1."""
    count = max(1, math.ceil(len(samples) / RATE * FPS))
    loudness, low, high = _measured(samples, count)
    opening = _smooth(_opening(loudness))
    low, high = _smooth(low), _smooth(high)
    seconds = np.arange(count) / FPS
    blink = np.array([blink_at(moment) for moment in seconds])
    given = {
        "jawOpen": _JAW * opening * (1 - _LESS_JAW * high),
        "mouthLowerDownLeft": _LOWER_LIP * opening,
        "mouthLowerDownRight": _LOWER_LIP * opening,
        "mouthUpperUpLeft": _UPPER_LIP * opening,
        "mouthUpperUpRight": _UPPER_LIP * opening,
        "mouthFunnel": _FUNNEL * opening * low,
        "mouthStretchLeft": _STRETCH * opening * high,
        "mouthStretchRight": _STRETCH * opening * high,
        "eyeBlinkLeft": blink,
        "eyeBlinkRight": blink,
    }
    coefficients = np.zeros((count, len(ARKIT_NAMES)), np.float32)
    for name, values in given.items():
        coefficients[:, ARKIT_NAMES.index(name)] = values
    still = np.zeros((count, 3), np.float32)
    return Motion(FPS, coefficients, np.zeros((count, 2, 3), np.float32), sway_at(seconds), still, 0)


def _measured(samples: Float32[np.ndarray, " n"], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loudness in dB around each moment, and how much of it is low and how much is high, 0..1."""
    size = round(_WINDOW * RATE)
    padded = np.pad(samples, (size // 2, size + RATE))
    starts = np.round(np.arange(count) / FPS * RATE).astype(int)
    window = np.hanning(size)
    frequencies = np.fft.rfftfreq(size, 1 / RATE)
    power, low, high = np.empty(count), np.empty(count), np.empty(count)
    for index, start in enumerate(starts):
        piece = padded[start : start + size].astype(np.float64)
        piece = (piece - piece.mean()) * window
        spectrum = np.abs(np.fft.rfft(piece)) ** 2
        total = max(float(spectrum.sum()), 1e-20)
        power[index] = float((piece**2).sum()) / float((window**2).sum())
        low[index] = spectrum[frequencies < _SPLIT_LOW].sum() / total
        high[index] = spectrum[frequencies > _SPLIT_HIGH].sum() / total
    # Most voices have most of their energy in low sounds, so only the rest of the way is rounding.
    return 10 * np.log10(np.maximum(power, 1e-12)), np.clip(2 * low - 1, 0, 1), np.clip(high, 0, 1)


def _opening(loudness: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """How open the mouth is, 0..1."""
    loud = float(np.percentile(loudness, _LOUD_SHARE))
    if loud < _SILENCE:
        return np.zeros(len(loudness))
    floor = float(np.clip(np.percentile(loudness, _FLOOR_SHARE), loud - _MOST_RANGE, loud - _LEAST_RANGE))
    above = (loudness - floor) / (loud - floor)
    return np.clip((above - _GATE) / (1 - _GATE), 0, 1) ** _SHAPE


def _smooth(values: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    reach = math.ceil(3 * _SMOOTHING * FPS)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (_SMOOTHING * FPS)) ** 2)
    padded = np.pad(values, reach, mode="edge")
    return np.convolve(padded, weights / weights.sum(), mode="valid")


def blink_at(seconds: float) -> float:
    """How closed the lids are at a time, 0..1. There is one blink in each stretch of time, as in the exported page."""
    stretch = math.floor(seconds / _BETWEEN)
    since = seconds - _BETWEEN * (stretch + 0.7 * _random(stretch))
    if not 0 <= since <= _CLOSING + _OPENING:
        return 0.0
    return since / _CLOSING if since < _CLOSING else 1 - (since - _CLOSING) / _OPENING


def _random(seed: int) -> float:
    """A number from 0 to 1 that an integer decides."""
    x = math.sin(12.9898 * seed + 78.233) * 43758.5453
    return x - math.floor(x)


def sway_at(seconds: Float[np.ndarray, " t"]) -> Float32[np.ndarray, "t 3"]:
    """Turns of a head that is never quite still, as axis-angle vectors in radians: sums of slow waves from 0."""
    waves = np.stack([size * _wave(seconds, k) for k, size in enumerate(_SWAY)], axis=1)
    turns = matrix_from_axis_angle(waves)
    return axis_angle_from_matrix(turns[0].T @ turns).astype(np.float32)


def _wave(seconds: Float[np.ndarray, " t"], k: int) -> Float[np.ndarray, " t"]:
    slow, fast = 0.61 * (1 + 0.37 * k), 1.13 * (1 + 0.21 * k)
    return np.sin(slow * seconds + 2.1 * k) + 0.6 * np.sin(fast * seconds + 4.3 * k)
