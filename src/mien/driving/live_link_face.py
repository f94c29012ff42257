"""Live Link Face: the csv of ARKit blend shapes that the iPhone app writes.

The columns are Timecode (HH:MM:SS:FF.fraction), BlendshapeCount, 52 coefficients with a capital first letter
(EyeBlinkLeft), then optionally HeadYaw, HeadPitch, HeadRoll and Yaw, Pitch, Roll of LeftEye and RightEye. Angles are in
radians, in the order yaw, pitch, roll. Yaw is positive to the subject's right, pitch downwards, roll to the subject's
left shoulder. These are Unreal's angles of ARKit's transforms. Their signs and order were checked for the eyes on real
takes, against the eyeLook coefficients; those of the head are assumed to be the same.
"""

import csv
import io
import math
import re
from pathlib import Path

import numpy as np

from mien.driving.motion import (
    ARKIT_NAMES,
    MAX_COEFFICIENT,
    MIN_COEFFICIENT,
    Motion,
    check_times,
    gaze_of,
    open_recording,
    repeat_lost,
    resample_evenly,
    shorten,
)
from mien.errors import UserError
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

HEAD = ("HeadYaw", "HeadPitch", "HeadRoll")
EYES = tuple(f"{side}Eye{angle}" for side in ("Left", "Right") for angle in ("Yaw", "Pitch", "Roll"))
_TIMECODE = re.compile(r"([0-9]{1,4}):([0-9]{1,2}):([0-9]{1,2})[:;]([0-9]{1,4})(?:\.([0-9]{1,20}))?")
_RATES = (24, 25, 30, 48, 50, 60, 90, 120, 240)
_USUAL_RATE = 60
_SIDES = ("Left", "Right")
_ANGLES = {name.lower() for name in (*HEAD, *EYES)}


def read_live_link_face(path: Path, fps: float | None = None) -> Motion:
    """Read motion from a csv of Live Link Face. Rows without a face (count 0) repeat the row before.

    Args:
        path: The csv file.
        fps: Frames per second of the timecode. The default is the smallest usual rate above its highest frame number,
            or 60 for takes of less than a second.

    Raises:
        UserError: The file cannot be read, lacks columns, or a value is missing, NaN or out of range. The message names
            the line.
    """
    header, lines = _read_rows(path)
    columns = {name.strip().lower(): index for index, name in enumerate(header)}
    wanted = ["timecode", *(name.lower() for name in ARKIT_NAMES)]
    missing = [name[0].upper() + name[1:] for name in ("Timecode", *ARKIT_NAMES) if name.lower() not in columns]
    if missing:
        raise UserError(
            f"{path}: lacks the columns {', '.join(missing[:5])}{' ...' if len(missing) > 5 else ''}; give a csv of "
            "Live Link Face (Timecode, BlendshapeCount, 52 ARKit names)"
        )
    angles = [name for name in (*HEAD, *EYES) if name.lower() in columns]
    indices = [columns[name] for name in (*wanted[1:], *(name.lower() for name in angles))]
    found = np.array([_has_face(row, columns, len(header)) for _, row in lines])
    if not found.any():
        raise UserError(f"{path}: no row has a face; record it again")
    values = np.zeros((len(lines), len(indices)))
    for row_index in np.flatnonzero(found):
        line, row = lines[row_index]
        if len(row) < len(header):
            raise UserError(f"{path}, line {line}: has {len(row)} of {len(header)} values; correct or delete the line")
        values[row_index] = [_number(path, line, header[index], row[index]) for index in indices]
    stamp = columns["timecode"]
    seconds = _seconds(path, [(line, row[stamp] if stamp < len(row) else "") for line, row in lines], fps)
    check_times(seconds, lambda row_index: f"{path}, line {lines[row_index][0]}")
    rate, values = resample_evenly(seconds, repeat_lost(values, found))
    coefficients = values[:, :52].astype(np.float32)
    turns = {name: values[:, 52 + index] for index, name in enumerate(angles)}
    zero = np.zeros((len(values), 3), np.float32)
    head = _turned(*(turns[name] for name in HEAD)) if all(name in turns for name in HEAD) else zero
    eyes = gaze_of(coefficients)
    if not eyes.any() and all(name in turns for name in EYES):
        sides = [_turned(*(turns[f"{side}Eye{angle}"] for angle in ("Yaw", "Pitch", "Roll"))) for side in _SIDES]
        eyes = np.stack(sides, axis=1)
    return Motion(rate, coefficients, eyes, head, zero, int((~found).sum()))


def _read_rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header, and all further rows that are not empty, with their line numbers."""
    try:
        with io.TextIOWrapper(open_recording(path), encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as csv ({error}); give a csv of Live Link Face") from None
    if len(rows) < 2:
        raise UserError(f"{path}: has no frames; give a csv of Live Link Face with a header and one row for each frame")
    return rows[0][1], rows[1:]


def _has_face(row: list[str], columns: dict[str, int], width: int) -> bool:
    """Whether a row has a face. If the face is lost, the app writes a count of 0, with or without zeros after it."""
    count = columns.get("blendshapecount")
    return not (count is not None and count < len(row) and row[count].strip() == "0" and len(row) <= width)


def _number(path: Path, line: int, name: str, text: str) -> float:
    where = f"{path}, line {line}: {name}"
    try:
        value = float(text)
    except ValueError:
        raise UserError(f"{where} is {shorten(text)!r}, not a number; correct or delete the line") from None
    if name.strip().lower() in _ANGLES:
        if not abs(value) <= math.pi:
            raise UserError(
                f"{where} is {shorten(text)}; angles are in radians, from -3.14 to 3.14; convert it if it is in degrees"
            )
    elif not MIN_COEFFICIENT <= value <= MAX_COEFFICIENT:
        raise UserError(f"{where} is {shorten(text)}; coefficients go from 0 to 1; correct or delete the line")
    return value


def _seconds(path: Path, timecodes: list[tuple[int, str]], fps: float | None) -> np.ndarray:
    parsed = []
    for line, text in timecodes:
        match = _TIMECODE.fullmatch(text.strip())
        if match is None:
            raise UserError(
                f"{path}, line {line}: Timecode {shorten(text)!r} is not HH:MM:SS:FF.fraction; correct or delete the "
                "line"
            )
        hours, minutes, seconds, frame = (int(part) for part in match.groups()[:4])
        parsed.append((3600 * hours + 60 * minutes + seconds, frame + float(f"0.{match.group(5) or 0}")))
    whole, frames = np.array(parsed).T
    if fps is None:
        spans_seconds = whole.max() > whole.min()
        fps = next((rate for rate in _RATES if rate > frames.max()), 1000) if spans_seconds else _USUAL_RATE
    times = whole + frames / fps
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        line = timecodes[int(back[0]) + 1][0]
        raise UserError(
            f"{path}, line {line}: its Timecode does not come after the one before; delete the line, or set --fps"
        )
    return times


def _turned(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Axis-angle rotation of yaw, then pitch, then roll about the turned axes, in the frame of `Motion`."""
    x, y, z = np.eye(3)
    turn = [matrix_from_axis_angle(angle[:, None] * axis) for angle, axis in ((yaw, -y), (pitch, x), (roll, -z))]
    return axis_angle_from_matrix(turn[0] @ turn[1] @ turn[2]).astype(np.float32)
