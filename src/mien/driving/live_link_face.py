"""Csv of ARKit's blend shapes: what the iPhone app Live Link Face writes, and tables of other programs.

Live Link Face has the columns Timecode (HH:MM:SS:FF.fraction), BlendshapeCount, 52 coefficients with a capital first
letter (EyeBlinkLeft), then optionally HeadYaw, HeadPitch, HeadRoll and Yaw, Pitch, Roll of LeftEye and RightEye. Angles
are in radians, in the order yaw, pitch, roll. Yaw is positive to the subject's right, pitch downwards, roll to the
subject's left shoulder. These are Unreal's angles of ARKit's transforms. Their signs and order were checked for the
eyes on real takes, against the eyeLook coefficients; those of the head are assumed to be the same.

Other tables have a column timestamp_ms, time (seconds) or frame instead of the timecode, and any of ARKit's names.

Left and right are the performer's in all recordings, but jaw and mouth of Live Link Face slide to the observer's sides
(docs/conventions.md has the table):

- In two public takes, MouthLeft - MouthRight goes against MouthUpperUpLeft - MouthUpperUpRight (correlation -0.91 and
  -0.81). In pictures, a mouth that slides to one side lifts the lip of that side: with MediaPipe, whose MouthLeft moves
  the lips to the performer's left (+0.92 with their place), the correlation is +0.56.
- JawLeft - JawRight goes with MouthLeft - MouthRight in the same takes (+0.83 and +0.85), as in pictures (+0.32), so
  the jaw has the sides of the mouth.
- An importer for Blender has a switch that exchanges MouthLeft and MouthRight of the app.
"""

import csv
import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.disk.tables import table_rows, with_point
from mien.driving.blendshape_json import arkit_index
from mien.driving.motion import (
    ARKIT_NAMES,
    MAX_COEFFICIENT,
    MIN_COEFFICIENT,
    Motion,
    Times,
    evenly_timed,
    gaze_of,
    open_recording,
    out_of_range,
    shorten,
)
from mien.errors import UserError
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

HEAD = ("HeadYaw", "HeadPitch", "HeadRoll")
EYES = tuple(f"{side}Eye{angle}" for side in ("Left", "Right") for angle in ("Yaw", "Pitch", "Roll"))
_TIMECODE = re.compile(r"([0-9]{1,4}):([0-9]{1,2}):([0-9]{1,2})[:;]([0-9]{1,4})(?:\.([0-9]{1,20}))?")
_RATES = (24, 25, 30, 48, 50, 60, 90, 120, 240)
_DAY = 86_400  # seconds. A timecode that goes back by more than half of them has passed midnight
_TIMECODE_NAME, _FRAME = "timecode", "frame"
_UNITS = {"timestamp_ms": 1000.0, "timestampms": 1000.0, "time": 1.0}  # columns of times, and their units in a second
_ASSUMED_RATE = 30.0  # rows a second of a table that has only frame numbers
_MAX_TURN, _MAX_SPEED = 1.7, 20.0
"""Largest yaw and pitch of a head or an eye that a camera sees, in radians, and largest speed of a head in radians a
second. A smaller number of degrees is soon beyond them."""
_DEGREES = "divide degrees by 57.3"
_EXCHANGED = {"jawLeft": "jawRight", "jawRight": "jawLeft", "mouthLeft": "mouthRight", "mouthRight": "mouthLeft"}
"""Coefficients that have the observer's sides in Live Link Face, with those of the performer's."""


def read_live_link_face(path: Path, fps: float | None = None) -> Motion:
    """Read motion from a csv of Live Link Face, or of any program that has ARKit's names and a column of times.

    Rows without a face (count 0) repeat the row before. `fps` are frames per second of the timecode, or rows a second
    where its frame field never changes and where there is no timecode. The default is the smallest usual rate above its
    highest frame number, or 60 for takes of less than a second.
    """
    try:
        rows = list(table_rows(open_recording(path)))
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as csv ({error}); give a csv of Live Link Face") from None
    if len(rows) < 2:
        raise UserError(f"{path}: has no frames; give a csv of Live Link Face with a header and one row for each frame")
    (_, header), *lines = rows
    columns = {_canonical(name): index for index, name in enumerate(header)}
    notes = _check_columns(path, columns)
    names = [name for name in (*ARKIT_NAMES, *HEAD, *EYES) if name in columns]
    indices = [columns[name] for name in names]
    # If the face is lost, the app writes a count of 0, with or without zeros after it.
    count = slice(columns.get("blendshapecount"), columns.get("blendshapecount", -1) + 1)
    found = np.array([[cell.strip() for cell in row[count]] != ["0"] or len(row) > len(header) for _, row in lines])
    if not found.any():
        raise UserError(f"{path}: no row has a face; record it again")
    values = np.zeros((len(lines), len(indices)))
    for row_index in np.flatnonzero(found):
        line, row = lines[row_index]
        if len(row) < len(header):
            raise UserError(f"{path}, line {line}: has {len(row)} of {len(header)} values; correct or delete the line")
        values[row_index] = [_number(path, line, header[index], row[index]) for index in indices]
    seconds, times, assumed = _seconds(path, columns, header, lines, fps)
    _check_speeds(times, seconds, {name: values[:, names.index(name)] for name in HEAD if name in names}, found)
    rate, values, lost, said = evenly_timed(path, times, seconds, values, found)
    by_name = dict(zip(names, values.T, strict=True))
    zero = np.zeros(len(values))
    exchanged = _EXCHANGED if _TIMECODE_NAME in columns else {}
    names = (exchanged.get(name, name) for name in ARKIT_NAMES)
    coefficients = np.stack([by_name.get(name, zero) for name in names], axis=1).astype(np.float32)
    still = np.zeros((len(values), 3), np.float32)
    head = _turned(*(by_name[name] for name in HEAD)) if all(name in by_name for name in HEAD) else still
    eyes = gaze_of(coefficients)
    if not eyes.any() and all(name in by_name for name in EYES):
        # The angles of eyes count only if all eyeLook coefficients are zero.
        eyes = np.stack([_turned(*(by_name[name] for name in names)) for names in (EYES[:3], EYES[3:])], axis=1)
    return Motion(rate, coefficients, eyes, head, still, lost, (*notes, *assumed, *said))


def _canonical(name: str) -> str:
    """A column's name as ARKit or the app spells it, or in lower case."""
    place, lower = arkit_index(name.strip()), name.strip().lower()
    return _SPELLINGS.get(lower, lower) if place is None else ARKIT_NAMES[place]


_SPELLINGS = {name.lower(): name for name in (*ARKIT_NAMES, *HEAD, *EYES)}


def _check_columns(path: Path, columns: dict[str, int]) -> tuple[str, ...]:
    """Refuse a csv without the columns that it needs. Returns lines for the user on coefficients that stay 0."""
    missing = [name[0].upper() + name[1:] for name in ARKIT_NAMES if name not in columns]
    if not {_TIMECODE_NAME, _FRAME, *_UNITS} & columns.keys() or len(missing) == len(ARKIT_NAMES):
        raise UserError(
            f"{path}: lacks ARKit's names, or a column Timecode, timestamp_ms, time or frame; give a csv of Live Link "
            "Face, or one with such columns"
        )
    tongue = "TongueOut"  # came a year after the others
    if missing == [tongue]:
        return (f"{path}: has no column {tongue}, so the tongue stays in",)
    needed = [name for name in missing if name != tongue]
    shown = ", ".join(needed[:5]) + (" ..." if len(needed) > 5 else "")
    if needed and _TIMECODE_NAME in columns:
        raise UserError(
            f"{path}: lacks the columns {shown}; give a csv of Live Link Face (Timecode, BlendshapeCount, 52 ARKit "
            "names)"
        )
    return (f"{path}: has no columns {shown} ({len(missing)} in all), so they stay 0",) if missing else ()


def _number(path: Path, line: int, name: str, text: str) -> float:
    where = f"{path}, line {line}: {name}"
    try:
        value = float(with_point(text))
    except ValueError:
        remedy = "divide percent by 100" if text.strip().endswith("%") else "correct or delete the line"
        raise UserError(f"{where} is {shorten(text)!r}, not a number; {remedy}") from None
    if _canonical(name) in (*HEAD, *EYES):
        most = math.pi if name.strip().lower().endswith("roll") else _MAX_TURN
        if not abs(value) <= most:
            raise UserError(
                f"{where} is {shorten(text)}; angles are in radians, and no camera sees a face beyond {most:.3g}; "
                f"{_DEGREES}, or delete the line"
            )
    elif not MIN_COEFFICIENT <= value <= MAX_COEFFICIENT:
        raise UserError(f"{where} is {shorten(text)}; {out_of_range(value)}")
    return value


def _check_speeds(
    times: Times, seconds: Float[np.ndarray, " r"], angles: dict[str, Float[np.ndarray, " r"]], found: np.ndarray
) -> None:
    """Refuse a head that turns faster than heads do, which is one whose angles are in degrees."""
    both = found[1:] & found[:-1]
    steps = np.diff(seconds)
    if not (steps > 0).any():
        return
    steps = np.maximum(steps, np.median(steps[steps > 0]))
    for name, values in angles.items():
        speeds = np.where(both, np.abs((np.diff(values) + np.pi) % (2 * np.pi) - np.pi), 0) / steps
        fastest = int(np.argmax(speeds))
        if speeds[fastest] > _MAX_SPEED:
            raise UserError(
                f"{times.where(fastest + 1)}: {name} goes from {values[fastest]:.4g} to {values[fastest + 1]:.4g} in "
                f"{steps[fastest]:.2g} s; angles are in radians, and no head turns by more than {_MAX_SPEED:g} a "
                f"second; {_DEGREES}, or delete the line"
            )


def _seconds(
    path: Path, columns: dict[str, int], header: list[str], lines: list[tuple[int, list[str]]], fps: float | None
) -> tuple[np.ndarray, Times, tuple[str, ...]]:
    """Times in seconds, which go on after midnight, what the file calls them, and a line on what is assumed."""
    key = next(name for name in (_TIMECODE_NAME, *_UNITS, _FRAME) if name in columns)
    name, column = header[columns[key]].strip(), columns[key]
    cells = [(line, row[column] if column < len(row) else "") for line, row in lines]
    own = {"name": name, "where": lambda index: f"{path}, line {lines[index][0]}"}
    faster = "`mien drive --fps 60` takes them for 60 a second"
    if key == _TIMECODE_NAME:
        whole, frames = _timecodes(path, cells)
        if fps is None or frames.astype(int).min() < frames.astype(int).max():
            if fps is not None and fps <= int(frames.max()):
                last = int(frames.max())
                raise UserError(f"{path}: --fps {fps:g}: its frame numbers go up to {last}; give more than that")
            usual = next((rate for rate in _RATES if rate > frames.max()), 1000) if whole.max() > whole.min() else 60
            rate, remedy = fps or usual, "; delete the line, or set --fps"
            return whole + frames / rate, Times(**own, slack=1 / rate, remedy=remedy, faster=faster), ()
    elif key == _FRAME:
        numbers = _clock(path, name, cells)
        line = f"{path}: has frame numbers and no times, so {_ASSUMED_RATE:g} rows a second are assumed; --fps sets it"
        return numbers / (fps or _ASSUMED_RATE), Times(**own), () if fps or len(cells) < 2 else (line,)
    elif fps is None:
        return _clock(path, name, cells) / _UNITS[key], Times(**own, units=_UNITS[key], faster=faster), ()
    return np.arange(len(cells)) / fps, Times(**own), ()


def _clock(path: Path, name: str, cells: list[tuple[int, str]]) -> np.ndarray:
    """The numbers of a column of times."""
    for line, text in cells:
        try:
            good = abs(float(with_point(text))) < 1e15
        except ValueError:
            good = False
        if not good:
            raise UserError(f"{path}, line {line}: {name} is {shorten(text)!r}; give every row a number")
    return np.array([float(with_point(text)) for _, text in cells])


def _timecodes(path: Path, cells: list[tuple[int, str]]) -> tuple[np.ndarray, np.ndarray]:
    """Whole seconds of timecodes, which go on after midnight, and frame numbers."""
    parsed = []
    for line, text in cells:
        match = _TIMECODE.fullmatch(with_point(text.strip()))
        if match is None:
            raise UserError(
                f"{path}, line {line}: Timecode {shorten(text)!r} is not HH:MM:SS:FF.fraction; correct or delete the "
                "line"
            )
        hours, minutes, seconds, frame = (int(part) for part in match.groups()[:4])
        parsed.append((3600 * hours + 60 * minutes + seconds, frame + float(f"0.{match.group(5) or 0}")))
    whole, frames = np.array(parsed).T
    return whole + _DAY * np.cumsum(np.diff(whole, prepend=whole[0]) < -_DAY / 2), frames


def _turned(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Axis-angle rotation of yaw, then pitch, then roll about the turned axes, in the frame of `Motion`."""
    x, y, z = np.eye(3)
    turn = [matrix_from_axis_angle(angle[:, None] * axis) for angle, axis in ((yaw, -y), (pitch, x), (roll, -z))]
    return axis_angle_from_matrix(turn[0] @ turn[1] @ turn[2]).astype(np.float32)
