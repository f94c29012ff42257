"""Motion of a driver's face over time, in ARKit's terms, from any recorder."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float, Float32

from mien.disk.reading import NotOrdinaryError, open_ordinary
from mien.errors import UserError
from mien.runtime.named import gaze_of as pitch_and_yaw

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
"""ARKit's 52 blend shapes, in the order of Live Link Face's columns. Left and right are the performer's."""
PAIRS = tuple((name, name[:-4] + "Right") for name in ARKIT_NAMES if name.endswith("Left"))

MAX_GAP_SECONDS = 60.0  # longest gap between two moments that is interpolated. A longer one means another recording
MAX_MOMENTS = 500_000  # in a recording: about two hours at 60 per second
MAX_FILE_BYTES = 128 << 20  # largest recording that is read. An hour of Live Link Face has about this size
_SLOWEST = 5.0  # least number of moments a second of a recording of a face
_SHORTEST, _LONGEST = 1 / 500, 3.0  # seconds between two moments. A median beyond them means another unit
# Coefficients go from 0 to 1, and a little beyond in programs that calibrate or exaggerate.
MIN_COEFFICIENT, MAX_COEFFICIENT = -0.5, 1.5


@dataclass(frozen=True, eq=False)
class Motion:
    """A face at t evenly spaced moments. The driver's face at rest is all zeros."""

    fps: float
    """Moments per second."""
    coefficients: Float32[np.ndarray, "t 52"]
    """Coefficients of `ARKIT_NAMES`, 0..1."""
    eyes: Float32[np.ndarray, "t 2 3"]
    """Axis-angle rotations of left and right eye in the head frame (+x to the subject's left, +y up, +z ahead), in
    radians."""
    head_rotation: Float32[np.ndarray, "t 3"]
    """Axis-angle rotation of the head in the world (+y up, +z towards the camera), in radians; zeros if unknown."""
    head_translation: Float32[np.ndarray, "t 3"]
    """Translation of the head in metres; zeros if unknown."""
    lost: int
    """Number of recorded frames without a face. They repeat the frame before."""
    notes: tuple[str, ...] = ()
    """What the reader assumed or left out: a line for the user for each."""

    def __len__(self) -> int:
        """The number of moments, t."""
        return len(self.coefficients)


def gaze_of(coefficients: Float32[np.ndarray, "t 52"]) -> Float32[np.ndarray, "t 2 3"]:
    """Rotations of the eyes for eyeLook coefficients: positive about x is down, about y to the subject's left."""
    look = {name: coefficients[:, index] for index, name in enumerate(ARKIT_NAMES) if name.startswith("eyeLook")}
    eyes = np.zeros((len(coefficients), 2, 3), np.float32)
    for index, side in enumerate(("Left", "Right")):
        eyes[:, index, 0], eyes[:, index, 1] = pitch_and_yaw(look, side)
    return eyes


@dataclass(frozen=True)
class Times:
    """A file's name for its times, and what messages say of them; `where` names a row's place in the file."""

    name: str
    where: Callable[[int], str]
    units: float | None = None
    """Units of the times in a second. None for times that cannot have another unit, such as a timecode."""
    slack: float = 0.0
    """How far a time may go back to count as a repeat, in seconds."""
    remedy: str = ""
    faster: str = "correct its times"
    """The remedy where there are too few rows a second."""


def evenly_timed(
    path: Path, times: Times, seconds: Float[np.ndarray, " r"], rows: Float[np.ndarray, "r c"], found: np.ndarray
) -> tuple[float, Float[np.ndarray, "t c"], int, tuple[str, ...]]:
    """Return frames per second, rows at evenly spaced times, the number of rows without a face, and lines for the user.

    Rows that repeat a time are left out. Rows without a face (not `found`) repeat the last one before them, or at the
    start the first one with a face. Rows at uneven times are interpolated linearly.
    """
    kept, notes = _without_repeats(seconds, times)
    if times.units is not None:
        _check_unit(path, times.name, times.units, seconds[kept])
    check_times(seconds[kept], lambda index: times.where(int(kept[index])))
    last = np.maximum.accumulate(np.where(found, np.arange(len(rows)), -1))
    filled = rows[np.where(last < 0, int(np.argmax(found)), last)]
    fps, even, at = 30.0, filled[kept], seconds[kept]
    if len(kept) > 1:
        step = float(np.median(np.diff(at)))
        count = round((at[-1] - at[0]) / step) + 1
        moments = at[0] + step * np.arange(count)
        if count == len(kept) and np.abs(moments - at).max() < 0.5 * step:
            fps = (len(kept) - 1) / float(at[-1] - at[0])
        else:
            fps, even = 1 / step, np.stack([np.interp(moments, at, column) for column in even.T], axis=1)
    if len(kept) > 1 and fps < _SLOWEST:
        line = (
            f"{path}: has {fps:.2g} rows a second, and recordings of faces have at least {_SLOWEST:g}; {times.faster}"
        )
        notes = (*notes, line)
    return fps, even, int((~found[kept]).sum()), notes


def _check_unit(path: Path, name: str, units: float, seconds: Float[np.ndarray, " r"]) -> None:
    """Refuse times whose unit is another one than their name says."""
    if len(seconds) < 2:
        return
    step = float(np.median(np.diff(seconds)))
    told = f"{path}: {name} goes up by {units * step:.4g} a frame, so "
    if step < _SHORTEST:
        hint = 'give milliseconds, or call seconds "time"' if units > 1 else "give seconds"
        raise UserError(f"{told}there would be {1 / step:,.0f} frames in a second; {hint}")
    if step > _LONGEST:
        hint = "give milliseconds" if units > 1 else 'give seconds, or call milliseconds "timestamp_ms"'
        raise UserError(f"{told}a frame would last {step:,.0f} s; {hint}")


def out_of_range(value: float | int) -> str:
    """Say what is wrong with a coefficient beyond `MIN_COEFFICIENT` and `MAX_COEFFICIENT`, and what to do."""
    is_percent = 0 <= value <= 100 * MAX_COEFFICIENT
    return "coefficients go from 0 to 1; " + ("divide percent by 100" if is_percent else "correct or delete the row")


def shorten(text: str) -> str:
    """The text as messages show it, cut to 80 characters."""
    return text if len(text) <= 80 else f"{text[:80]}..."


def open_recording(path: Path) -> IO[bytes]:
    """Open a recording for reading. One that is too large, or that would never end, is refused."""
    try:
        file = open_ordinary(path)
    except NotOrdinaryError:
        raise UserError(f"{path}: is not an ordinary file; copy its content into one") from None
    if os.fstat(file.fileno()).st_size > MAX_FILE_BYTES:
        file.close()
        raise UserError(f"{path}: has more than {MAX_FILE_BYTES:,} bytes; cut it into shorter recordings")
    return file


def check_times(seconds: Float[np.ndarray, " r"], where: Callable[[int], str]) -> None:
    """Refuse increasing times between which too many moments would be interpolated. `where` names a row's place."""
    steps = np.diff(seconds)
    longest = int(np.argmax(steps)) if len(steps) else 0
    if len(steps) and steps[longest] > MAX_GAP_SECONDS:
        raise UserError(
            f"{where(longest + 1)}: comes {steps[longest]:,.0f} s after the one before, but only gaps of up to "
            f"{MAX_GAP_SECONDS:g} s are filled; cut the file there"
        )
    moments = float(seconds[-1] - seconds[0]) / float(np.median(steps)) if len(steps) else 1.0
    if max(moments, len(seconds)) > MAX_MOMENTS:
        raise UserError(
            f"{where(0)}: the times from here on give {moments:,.0f} moments, more than {MAX_MOMENTS:,}; cut the file "
            "into shorter ones"
        )


def _without_repeats(seconds: Float[np.ndarray, " r"], times: Times) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the indices of rows whose time comes after all before, and a line for the user on those left out."""
    latest = np.maximum.accumulate(seconds)
    late = np.concatenate([[False], seconds[1:] <= latest[:-1]])
    back = np.concatenate([[False], seconds[1:] < latest[:-1] - times.slack])
    if late[1:].any() and late[1:].all():
        back[1] = True
    if back.any():
        place = times.where(int(np.argmax(back)))
        raise UserError(f"{place}: its {times.name} does not come after the one before{times.remedy}")
    count = int(late.sum())
    line = f"{times.where(int(np.argmax(late)))}: has the time of a row before it and is left out; {count} in all"
    return np.flatnonzero(~late), (line,) if count else ()
