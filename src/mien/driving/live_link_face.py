"""Live Link Face: the csv of ARKit blend shapes that the iPhone app writes.

The columns are Timecode (HH:MM:SS:FF.fraction), BlendshapeCount, 52 coefficients with a capital first letter
(EyeBlinkLeft), then optionally HeadYaw, HeadPitch, HeadRoll and Yaw, Pitch, Roll of LeftEye and RightEye. Angles are in
radians, in the order yaw, pitch, roll. Yaw is positive to the subject's right, pitch downwards, roll to the subject's
left shoulder. These are Unreal's angles of ARKit's transforms. Their signs and order were checked for the eyes on real
takes, against the eyeLook coefficients; those of the head are assumed to be the same. Jaw and mouth slide to the
observer's sides (`mien.driving.sides`).

Spreadsheets save such a file with semicolons or tabs, and with decimal commas. Both are read.
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mien.bounded import short_lines
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
    without_repeats,
)
from mien.driving.sides import LIVE_LINK_FACE, as_performer
from mien.errors import UserError
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle

HEAD = ("HeadYaw", "HeadPitch", "HeadRoll")
EYES = tuple(f"{side}Eye{angle}" for side in ("Left", "Right") for angle in ("Yaw", "Pitch", "Roll"))
_TIMECODE = re.compile(r"([0-9]{1,4}):([0-9]{1,2}):([0-9]{1,2})[:;]([0-9]{1,4})(?:\.([0-9]{1,20}))?")
_RATES = (24, 25, 30, 48, 50, 60, 90, 120, 240)
_USUAL_RATE = 60
_DAY = 86_400
"""Seconds of a day. A timecode that goes back by more than half of them has passed midnight."""
_OPTIONAL = "tongueOut"
"""The one coefficient that a csv may lack: it came a year after the others."""
_MAX_HEADER = 65_536
"""Largest number of characters of the first line that decide what separates the columns."""
_MAX_LINE = 1 << 20
"""Most characters of a line."""
_CELL_BYTES, _SHORT_CELL_BYTES, MAX_CELLS_BYTES = 72, 8, 5 << 28
"""Memory that the text of a value takes, also of one character, and most memory that all may take."""
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
    notes = _check_columns(path, columns)
    names = [name for name in (*ARKIT_NAMES, *HEAD, *EYES) if name.lower() in columns]
    indices = [columns[name.lower()] for name in names]
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
    timecodes = [(line, row[stamp] if stamp < len(row) else "") for line, row in lines]
    seconds, frame = _seconds(path, timecodes, fps)

    def where(index: int) -> str:
        return f"{path}, line {lines[index][0]}"

    kept, repeats = without_repeats(seconds, where, "Timecode", "; delete the line, or set --fps", frame)
    check_times(seconds[kept], lambda index: where(int(kept[index])))
    rate, values = resample_evenly(seconds[kept], repeat_lost(values, found)[kept])
    by_name = dict(zip(names, values.T, strict=True))
    zero = np.zeros(len(values))
    read = np.stack([by_name.get(name, zero) for name in ARKIT_NAMES], axis=1).astype(np.float32)
    coefficients = as_performer(read, LIVE_LINK_FACE)
    eyes, head = _turns(by_name, coefficients)
    still = np.zeros((len(values), 3), np.float32)
    return Motion(rate, coefficients, eyes, head, still, int((~found[kept]).sum()), (*notes, *repeats))


def _check_columns(path: Path, columns: dict[str, int]) -> tuple[str, ...]:
    """Refuse a csv without the columns that it needs. Returns a line for the user if the optional one is missing."""
    missing = [name[0].upper() + name[1:] for name in ("timecode", *ARKIT_NAMES) if name.lower() not in columns]
    tongue = _OPTIONAL[0].upper() + _OPTIONAL[1:]
    needed = [name for name in missing if name != tongue]
    if needed:
        raise UserError(
            f"{path}: lacks the columns {', '.join(needed[:5])}{' ...' if len(needed) > 5 else ''}; give a csv of "
            "Live Link Face (Timecode, BlendshapeCount, 52 ARKit names)"
        )
    return (f"{path}: has no column {tongue}, so the tongue stays in",) if missing else ()


def _turns(
    values: dict[str, np.ndarray], coefficients: Float32[np.ndarray, "t 52"]
) -> tuple[Float32[np.ndarray, "t 2 3"], Float32[np.ndarray, "t 3"]]:
    """Rotations of the eyes and of the head. The angles of eyes count only if all eyeLook coefficients are zero."""
    zero = np.zeros((len(coefficients), 3), np.float32)
    head = _turned(*(values[name] for name in HEAD)) if all(name in values for name in HEAD) else zero
    eyes = gaze_of(coefficients)
    if not eyes.any() and all(name in values for name in EYES):
        sides = [_turned(*(values[f"{side}Eye{angle}"] for angle in ("Yaw", "Pitch", "Roll"))) for side in _SIDES]
        eyes = np.stack(sides, axis=1)
    return eyes, head


def _read_rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header, and all further rows that are not empty, with their line numbers."""
    try:
        with io.TextIOWrapper(open_recording(path), encoding="utf-8-sig", newline="") as file:
            first = file.readline(_MAX_HEADER)
            if first.strip().lower().startswith("sep="):  # Excel's own hint, before the header.
                first = file.readline(_MAX_HEADER)
            delimiter = max(",;\t", key=first.count)
            file.seek(0)
            reader = csv.reader(short_lines(file, _MAX_LINE), delimiter=delimiter)
            rows = [(reader.line_num, row) for row in _bounded(reader) if any(cell.strip() for cell in row)]
        if rows and rows[0][1][0].lower().startswith("sep="):
            del rows[0]
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read as csv ({error}); give a csv of Live Link Face") from None
    if len(rows) < 2:
        raise UserError(f"{path}: has no frames; give a csv of Live Link Face with a header and one row for each frame")
    return rows[0][1], rows[1:]


def _bounded(rows: Iterable[list[str]]) -> Iterator[list[str]]:
    """The rows, as long as they fit into moderate memory.

    Raises:
        ValueError: they do not.
    """
    taken = 0
    for row in rows:
        # Texts of one character take no memory of their own.
        taken += len(row) * (_CELL_BYTES if sum(map(len, row)) > len(row) else _SHORT_CELL_BYTES)
        if taken > MAX_CELLS_BYTES:
            raise ValueError("it has too many values; cut it into shorter recordings")
        yield row


def _has_face(row: list[str], columns: dict[str, int], width: int) -> bool:
    """Whether a row has a face. If the face is lost, the app writes a count of 0, with or without zeros after it."""
    count = columns.get("blendshapecount")
    return not (count is not None and count < len(row) and row[count].strip() == "0" and len(row) <= width)


def _number(path: Path, line: int, name: str, text: str) -> float:
    where = f"{path}, line {line}: {name}"
    try:
        value = float(_with_point(text))
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


def _with_point(text: str) -> str:
    """The text of a number, with a decimal comma as a point."""
    return text.replace(",", ".") if text.count(",") == 1 and "." not in text else text


def _seconds(path: Path, timecodes: list[tuple[int, str]], fps: float | None) -> tuple[np.ndarray, float]:
    """Times in seconds, which go on after midnight, and the duration of a frame of the timecode."""
    parsed = []
    for line, text in timecodes:
        match = _TIMECODE.fullmatch(_with_point(text.strip()))
        if match is None:
            raise UserError(
                f"{path}, line {line}: Timecode {shorten(text)!r} is not HH:MM:SS:FF.fraction; correct or delete the "
                "line"
            )
        hours, minutes, seconds, frame = (int(part) for part in match.groups()[:4])
        parsed.append((3600 * hours + 60 * minutes + seconds, frame + float(f"0.{match.group(5) or 0}")))
    whole, frames = np.array(parsed).T
    midnights = np.diff(whole, prepend=whole[0]) < -_DAY / 2
    whole = whole + _DAY * np.cumsum(midnights)
    if fps is None:
        spans_seconds = whole.max() > whole.min()
        fps = next((rate for rate in _RATES if rate > frames.max()), 1000) if spans_seconds else _USUAL_RATE
    elif fps <= int(frames.max()):
        raise UserError(f"{path}: --fps {fps:g}: its frame numbers go up to {int(frames.max())}; give more than that")
    return whole + frames / fps, 1 / fps


def _turned(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Axis-angle rotation of yaw, then pitch, then roll about the turned axes, in the frame of `Motion`."""
    x, y, z = np.eye(3)
    turn = [matrix_from_axis_angle(angle[:, None] * axis) for angle, axis in ((yaw, -y), (pitch, x), (roll, -z))]
    return axis_angle_from_matrix(turn[0] @ turn[1] @ turn[2]).astype(np.float32)
