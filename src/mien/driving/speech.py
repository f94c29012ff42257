"""Motion from a voice: the jaw and the mouth open with its open vowels, and the head lives meanwhile.

It knows no words, so it makes mouths that fit the rhythm of speech, not its sounds. An open vowel, such as a, has much
energy at the first of its formants, and above 1,400 Hz. Closed ones (i, u) and sounds through closed lips (m, b) are as
loud, but below. So the level of these two bands opens the jaw. It counts in dB above the noise floor of the file,
because the ear hears it so and because recordings differ. Where most energy is at high frequencies (s, sh, i), the
mouth is wide and less open; where it is at low ones (o, u), the lips are rounded. Where the level drops for a moment
(p, b, m), the lips shut.
"""

import math

import numpy as np
from jaxtyping import Float, Float32

from mien.driving.motion import ARKIT_NAMES, Motion
from mien.media.video import RATE
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

_SPEECH_WINDOW = 0.04
"""Length of the pieces of sound that are measured, in seconds. Bands, weights, smoothing, exponent and drops were
chosen on 5 English sentences of 4 voices of a synthesiser, and judged on others (docs/using.md, "A voice")."""
SPEECH_BANDS = ((500.0, 900.0), (1400.0, 3000.0))  # Hz: of the first formants of open vowels, and above
SPEECH_BAND_WEIGHTS = (1.0, 0.5)  # how much the share of each band counts, in dB, beside the loudness
SPEECH_LEAST_SHARE = 10**-2.5  # smallest share of the energy that a band counts with
_SPEECH_SMOOTHING = 0.02  # deviation of the smoothing over time, in seconds: even before and after, so without lag
_SPEECH_FLOOR = 10  # percentile of the level that is the noise floor
_SPEECH_LOUD = 95  # percentile of the level that is a loud voice
_SPEECH_RANGE = (25.0, 45.0)  # bounds of the distance from the noise floor to a loud voice, in dB
_SPEECH_GATE = 0.15  # share of this distance above the noise floor that still counts as silence
_SPEECH_SILENCE = -55.0  # dB, where 0 is the loudest possible. Files that are never louder do not move the mouth
_SPEECH_EXPONENT = 2.0  # exponent from the level in dB to opening
_SPEECH_SPLIT = (700.0, 2500.0)  # frequencies in Hz below which sound is low, and above which it is high
_SPEECH_SHUT_WITHIN = 0.14  # time within which sound is as loud before and after a drop at which lips shut, in seconds
_SPEECH_SHUT_DROP = (14.0, 26.0)  # drops in dB at which lips begin to shut, and are shut. No real speech was compared
_SPEECH_SHUT_HISS = 6.0  # how much energy at high frequencies keeps lips open, as at s: from its inverse on, they are
_SPEECH_SHUT_BESIDE = 0.3  # how shut lips are in the picture before and after that in which they are shut
FPS = 30.0  # moments a second of the motion


def motion_of_sound(samples: Float32[np.ndarray, " n"]) -> Motion:
    """The motion for a sound as `mien.media.video.read_sound` reads it. The same sound gives the same motion."""
    count = max(1, math.ceil(len(samples) / RATE * FPS))
    loudness, level, low, high = _measured(samples, count)
    shut = _shut(level, high)
    opening = _smooth(_opening(loudness, level)) * (1 - shut)
    low, high = _smooth(low), _smooth(high)
    seconds = np.arange(count) / FPS
    blink = np.array([blink_at(moment) for moment in seconds])
    given = {
        "jawOpen": 0.55 * opening * (1 - 0.6 * high),
        "mouthLowerDownLeft": 0.25 * opening,
        "mouthLowerDownRight": 0.25 * opening,
        "mouthUpperUpLeft": 0.12 * opening,
        "mouthUpperUpRight": 0.12 * opening,
        "mouthFunnel": 0.35 * opening * low,
        "mouthStretchLeft": 0.3 * opening * high,
        "mouthStretchRight": 0.3 * opening * high,
        "mouthPressLeft": 0.3 * shut,
        "mouthPressRight": 0.3 * shut,
        "eyeBlinkLeft": blink,
        "eyeBlinkRight": blink,
    }
    coefficients = np.zeros((count, len(ARKIT_NAMES)), np.float32)
    for name, values in given.items():
        coefficients[:, ARKIT_NAMES.index(name)] = values
    still = np.zeros((count, 3), np.float32)
    return Motion(FPS, coefficients, np.zeros((count, 2, 3), np.float32), sway_at(seconds), still, 0)


def _measured(samples: Float32[np.ndarray, " n"], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Loudness and level of open vowels in dB around each moment, and how much is low and how much is high, 0..1."""
    size = round(_SPEECH_WINDOW * RATE)
    padded = np.pad(samples, (size // 2, size + RATE))
    starts = np.round(np.arange(count) / FPS * RATE).astype(int)
    window = np.hanning(size)
    frequencies = np.fft.rfftfreq(size, 1 / RATE)
    bands = [(frequencies >= lowest) & (frequencies < highest) for lowest, highest in SPEECH_BANDS]
    power, level, low, high = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for index, start in enumerate(starts):
        piece = padded[start : start + size].astype(np.float64)
        piece = (piece - piece.mean()) * window
        spectrum = np.abs(np.fft.rfft(piece)) ** 2
        total = max(float(spectrum.sum()), 1e-20)
        power[index] = float((piece**2).sum()) / float((window**2).sum())
        shares = [max(float(spectrum[band].sum()) / total, SPEECH_LEAST_SHARE) for band in bands]
        level[index] = 10 * np.dot(SPEECH_BAND_WEIGHTS, np.log10(shares))
        low[index] = spectrum[frequencies < _SPEECH_SPLIT[0]].sum() / total
        high[index] = spectrum[frequencies > _SPEECH_SPLIT[1]].sum() / total
    # Most voices have most of their energy in low sounds, so only the rest of the way is rounding.
    loudness = 10 * np.log10(np.maximum(power, 1e-12))
    return loudness, loudness + level, np.clip(2 * low - 1, 0, 1), np.clip(high, 0, 1)


def _opening(loudness: Float[np.ndarray, " t"], level: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """How open the mouth is, 0..1. What is no louder than the noise floor does not open it, whatever its bands."""
    if float(np.percentile(loudness, _SPEECH_LOUD)) < _SPEECH_SILENCE:
        return np.zeros(len(level))
    return _above_floor(level) ** _SPEECH_EXPONENT * (_above_floor(loudness) > 0)


def _above_floor(decibels: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """How far each moment is above the noise floor, 0..1, where 1 is a loud voice."""
    loud = float(np.percentile(decibels, _SPEECH_LOUD))
    bounds = loud - _SPEECH_RANGE[1], loud - _SPEECH_RANGE[0]
    floor = float(np.clip(np.percentile(decibels, _SPEECH_FLOOR), *bounds))
    above = (decibels - floor) / (loud - floor)
    return np.clip((above - _SPEECH_GATE) / (1 - _SPEECH_GATE), 0, 1)


def _shut(level: Float[np.ndarray, " t"], high: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """How shut the lips are in the midst of speech, 0..1: at p, b and m, the level drops for a moment without a hiss.

    So it does at t and k, behind open lips. The mouth shuts there, too, for a tenth of a second.
    """
    reach = round(_SPEECH_SHUT_WITHIN * FPS)
    around = np.pad(level, reach, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(around, reach + 1)
    drop = np.minimum(windows[: len(level)].max(1), windows[reach:].max(1)) - level
    least, most = _SPEECH_SHUT_DROP
    found = np.clip((drop - least) / (most - least), 0, 1) * (1 - np.clip(_SPEECH_SHUT_HISS * high, 0, 1))
    spread = np.pad(found, 1, mode="edge")
    return np.maximum(found, _SPEECH_SHUT_BESIDE * np.maximum(spread[:-2], spread[2:]))


def _smooth(values: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    reach = math.ceil(3 * _SPEECH_SMOOTHING * FPS)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (_SPEECH_SMOOTHING * FPS)) ** 2)
    padded = np.pad(values, reach, mode="edge")
    return np.convolve(padded, weights / weights.sum(), mode="valid")


def blink_at(seconds: float) -> float:
    """How closed the lids are at a time, 0..1. There is one blink in each stretch of time, as in the exported page."""
    every, closing, opening = 3.5, 0.08, 0.17  # seconds
    stretch = math.floor(seconds / every)
    since = seconds - every * (stretch + 0.7 * _random(stretch))
    if not 0 <= since <= closing + opening:
        return 0.0
    return since / closing if since < closing else 1 - (since - closing) / opening


def _random(seed: int) -> float:
    """A number from 0 to 1 that an integer decides."""
    x = math.sin(12.9898 * seed + 78.233) * 43758.5453
    return x - math.floor(x)


def sway_at(seconds: Float[np.ndarray, " t"]) -> Float32[np.ndarray, "t 3"]:
    """Turns of a head that is never quite still, as axis-angle vectors in radians: sums of slow waves from 0."""
    waves = []
    for k, size in enumerate((0.012, 0.02, 0.008)):  # about x, y and z, in radians
        slow, fast = 0.61 * (1 + 0.37 * k), 1.13 * (1 + 0.21 * k)
        waves.append(size * (np.sin(slow * seconds + 2.1 * k) + 0.6 * np.sin(fast * seconds + 4.3 * k)))
    turns = matrix_from_axis_angle(np.stack(waves, axis=1))
    return axis_angle_from_matrix(turns[0].T @ turns).astype(np.float32)
