"""Blend shapes as json: a plain list of frames, or what MediaPipe, BEAT, LAM and Audio2Face write.

`mien.driving.sources.json_layouts` describes the layouts. Times are in milliseconds as "timestamp_ms" (or
"timestampMs") and in seconds as "time". MediaPipe's matrices are in centimetres, with OpenGL axes. A frame without a
face repeats the frame before it.
"""

import difflib
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mien.disk.limits import has_last_row
from mien.disk.reading import parse_json
from mien.disk.tables import text_of
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
)
from mien.driving.sources.json_layouts import Recorded, Scores, arkit_index, recorded, short
from mien.driving.sources.sides import as_performer
from mien.errors import UserError
from mien.runtime.rotation import axis_angle_from_matrix, rotation_of

_NO_EXPRESSION = "_neutral"
_DEFAULT_FPS = 30.0
_CENTIMETER = 0.01
_MAX_TIME = 1e15
"""Largest time in a file. In milliseconds it is thirty thousand years, so the zero of any clock is accepted."""


def read_blendshape_json(path: Path) -> Motion:
    """Read motion from blend shapes as json."""
    try:
        with open_recording(path) as file:
            content = parse_json(text_of(file.read()), any_size=True, constants=True)
    except (OSError, ValueError, MemoryError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); give frames of blend shapes") from None
    read = recorded(content, path)
    found = np.array([scores is not None for scores in read.scores])
    rows = np.zeros((len(found), 52 + 6))
    for index, scores in enumerate(read.scores):
        if scores is not None:
            rows[index, :52] = _row(scores, f"{path}, frame {index}")
    turned = _place_heads(rows, read.matrices, path)
    if not found.any():
        raise UserError(f"{path}: no frame has a face; record it again")
    seconds, assumed = _seconds(read, path)
    times = Times(read.time_key, lambda index: f"{path}, frame {index}", read.units)
    fps, rows, lost, said = evenly_timed(path, times, seconds, rows, found)
    coefficients = as_performer(rows[:, :52].astype(np.float32), read.sides)
    head = rows[:, 52:].astype(np.float32)
    notes = (*read.notes, *turned, *assumed, *said)
    return Motion(fps, coefficients, gaze_of(coefficients), head[:, :3], head[:, 3:], lost, notes)


def _row(scores: Scores, where: str) -> Float[np.ndarray, " 52"]:
    row = np.zeros(52)
    for name, score in scores.items():
        if name == _NO_EXPRESSION:
            continue
        place = arkit_index(name)
        if place is None:
            near = difflib.get_close_matches(str(name), ARKIT_NAMES, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise UserError(f"{where}: there is no blend shape {short(name)}{hint}")
        is_number = isinstance(score, (int, float)) and not isinstance(score, bool)
        if not is_number or not MIN_COEFFICIENT <= score <= MAX_COEFFICIENT:
            remedy = out_of_range(score) if is_number else "give a number from 0 to 1"
            raise UserError(f"{where}: {name} is {short(score)}; {remedy}")
        row[place] = score
    return row


def _place_heads(rows: Float[np.ndarray, "t 58"], matrices: list[np.ndarray | None], path: Path) -> tuple[str, ...]:
    """Fill in rotations and translations of heads. Returns a line for the user if the matrices are transposed.

    A matrix without translation says nothing about its form, so all matrices of the file decide together.
    """
    given = [(index, matrix) for index, matrix in enumerate(matrices) if matrix is not None]
    transposed = not all(has_last_row(matrix) for _, matrix in given) and all(has_last_row(m.T) for _, m in given)
    for index, matrix in given:
        upright = matrix.T if transposed else matrix
        rotation = rotation_of(upright[:3, :3])
        if rotation is None:
            raise UserError(
                f"{path}, frame {index}: its facial transformation matrix is not a rotation; correct or delete it"
            )
        if not has_last_row(upright):
            shown = " ".join(f"{value:g}" for value in upright[3])
            raise UserError(
                f"{path}, frame {index}: the last row of its facial transformation matrix is {shown}, not 0 0 0 1; "
                "correct or delete it"
            )
        rows[index, 52:55] = axis_angle_from_matrix(rotation)
        rows[index, 55:] = _CENTIMETER * upright[:3, 3]
    return (f"{path}: its facial transformation matrices are transposed, and are read so",) if transposed else ()


def _seconds(read: Recorded, path: Path) -> tuple[Float[np.ndarray, " t"], tuple[str, ...]]:
    """Times of the frames in seconds, and a line for the user if the file has none."""
    if all(time is None for time in read.times):
        known = read.fps is not None or len(read.times) < 2
        line = f'{path}: has no times ("timestamp_ms", or "time" in seconds), so 30 frames a second are assumed'
        return np.arange(len(read.times)) / (read.fps or _DEFAULT_FPS), () if known else (line,)
    for index, time in enumerate(read.times):
        if isinstance(time, bool) or not isinstance(time, (int, float)) or not abs(time) < _MAX_TIME:
            raise UserError(f"{path}, frame {index}: {read.time_key} is {short(time)}; give every frame a number")
    return np.array(read.times, dtype=np.float64) / read.units, ()
