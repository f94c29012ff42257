"""Motion: what a driver's face does over time, in ARKit's terms, whatever recorded it."""

import math
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mien.errors import UserError

ARKIT_NAMES = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft",
    "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight",
    "eyeSquintRight", "eyeWideRight", "jawForward", "jawRight", "jawLeft", "jawOpen", "mouthClose", "mouthFunnel",
    "mouthPucker", "mouthRight", "mouthLeft", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft",
    "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight",
    "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft",
    "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft",
    "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut",
)  # fmt: skip
"""ARKit's 52 blend shapes, in the order of Live Link Face's columns."""

LOOK_ANGLE = math.radians(30)
"""How far an eye turns for an eyeLook coefficient of 1; Apple names no angle, and this is about as far as eyes go."""
LONGEST_GAP = 60.0
"""Seconds between two moments that are filled by a straight line; more is another recording."""
MOST_MOMENTS = 500_000
"""Two hours at 60 a second."""
LARGEST_FILE = 128 << 20
"""Bytes of a recording; an hour of Live Link Face has as many."""
SMALLEST, LARGEST = -0.5, 1.5
"""Coefficients go from 0 to 1; programs that calibrate or exaggerate go a little beyond."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A face at t evenly spaced moments; the driver's face at rest is all zeros."""

    fps: float
    """Moments a second."""
    coefficients: Float32[np.ndarray, "t 52"]
    """Of `ARKIT_NAMES`, 0..1."""
    eyes: Float32[np.ndarray, "t 2 3"]
    """Axis-angle of left and right eye in the head frame, radians (+x to the subject's left, +y up, +z ahead)."""
    head_rotation: Float32[np.ndarray, "t 3"]
    """Axis-angle of the head in the world (+y up, +z towards the camera), radians; zeros where nothing is known."""
    head_translation: Float32[np.ndarray, "t 3"]
    """Metres; zeros where nothing is known."""
    lost: int
    """Moments at which no face was found: they repeat the one before."""

    def __len__(self) -> int:
        """The number of moments, t."""
        return len(self.coefficients)


def gaze_of(coefficients: Float32[np.ndarray, "t 52"]) -> Float32[np.ndarray, "t 2 3"]:
    """How the eyes turn for eyeLook coefficients: down is positive about x, to the subject's left about y."""
    look = {name: coefficients[:, index] for index, name in enumerate(ARKIT_NAMES) if name.startswith("eyeLook")}
    eyes = np.zeros((len(coefficients), 2, 3), np.float32)
    for index, (side, left, right) in enumerate((("Left", "Out", "In"), ("Right", "In", "Out"))):
        eyes[:, index, 0] = LOOK_ANGLE * (look[f"eyeLookDown{side}"] - look[f"eyeLookUp{side}"])
        eyes[:, index, 1] = LOOK_ANGLE * (look[f"eyeLook{left}{side}"] - look[f"eyeLook{right}{side}"])
    return eyes


def evenly(seconds: Float[np.ndarray, " r"], rows: Float[np.ndarray, "r c"]) -> tuple[float, Float[np.ndarray, "t c"]]:
    """Frames a second and rows at even spacing: as they are if they are even already, else interpolated linearly.

    `seconds` increases strictly.
    """
    if len(rows) < 2:
        return 30.0, rows
    step = float(np.median(np.diff(seconds)))
    count = round((seconds[-1] - seconds[0]) / step) + 1
    even = seconds[0] + step * np.arange(count)
    if count == len(rows) and np.abs(even - seconds).max() < 0.5 * step:
        return (len(rows) - 1) / float(seconds[-1] - seconds[0]), rows
    return 1 / step, np.stack([np.interp(even, seconds, column) for column in rows.T], axis=1)


def check_size(path: Path) -> None:
    """Refuse a recording that would fill the memory, or that would be waited for, before it is opened.

    Raises:
        UserError: it has more than `LARGEST_FILE` bytes, or is a pipe, a device or a folder.
        OSError: it is missing.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise UserError(f"{path}: is no ordinary file; copy it to one")
    if path.stat().st_size > LARGEST_FILE:
        raise UserError(f"{path}: has more than {LARGEST_FILE:,} bytes; cut it into shorter recordings")


def check_times(seconds: Float[np.ndarray, " r"], where: Callable[[int], str]) -> None:
    """Refuse times that `evenly` would fill with moments that nobody recorded.

    Args:
        seconds: increasing strictly.
        where: names a row's place in its file.

    Raises:
        UserError: a gap is longer than `LONGEST_GAP`, or there would be more than `MOST_MOMENTS`.
    """
    steps = np.diff(seconds)
    longest = int(np.argmax(steps)) if len(steps) else 0
    if len(steps) and steps[longest] > LONGEST_GAP:
        raise UserError(
            f"{where(longest + 1)}: comes {steps[longest]:,.0f} s after the one before, and gaps of up to "
            f"{LONGEST_GAP:g} s are filled; cut the file there"
        )
    moments = float(seconds[-1] - seconds[0]) / float(np.median(steps)) if len(steps) else 1.0
    if max(moments, len(seconds)) > MOST_MOMENTS:
        raise UserError(
            f"{where(0)}: the times from here on make {moments:,.0f} moments, more than {MOST_MOMENTS:,}; cut the file "
            "into shorter ones"
        )


def held(rows: Float[np.ndarray, "r c"], found: np.ndarray) -> Float[np.ndarray, "r c"]:
    """Rows where no face was found repeat the last one before them (the first found one, at the start)."""
    last = np.maximum.accumulate(np.where(found, np.arange(len(rows)), -1))
    return rows[np.where(last < 0, int(np.argmax(found)), last)]
