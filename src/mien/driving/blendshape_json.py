"""Blend shapes as json: a plain list of frames, or the results of MediaPipe's FaceLandmarker.

The plain format is [{"timestamp_ms": 0, "blendshapes": {"jawOpen": 0.3, ...}}, ...]. Missing names are 0.

The FaceLandmarker format is one result of its JavaScript API or a list of them, with "timestamp_ms" (or "timestampMs")
added: {"faceBlendshapes": [{"categories": [{"categoryName": .., "score": ..}, ...]}],
 "facialTransformationMatrixes": [{"rows": 4, "columns": 4, "data": [16 numbers, column by column]}]}. Matrices are in
centimetres, with OpenGL axes. Only the first face counts.

A frame without a face repeats the frame before it.
"""

import difflib
from pathlib import Path
from typing import Any

import numpy as np

from mien.bounded import parse_json
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
from mien.runtime.rotation import axis_angle_from_matrix, rotation_of

_INDEX = {name: index for index, name in enumerate(ARKIT_NAMES)}
_NO_EXPRESSION = "_neutral"
_DEFAULT_FPS = 30.0
_CENTIMETRE = 0.01
_MAX_MATRIX_ENTRY = 1e6
"""Largest number in a transformation matrix (translations are in centimetres)."""
_MAX_MILLISECONDS = 1e15
"""Largest timestamp in milliseconds: thirty thousand years, so the zero of any clock is accepted."""


def read_blendshape_json(path: Path) -> Motion:
    """Read motion from blend shapes as json.

    Raises:
        UserError: The file cannot be read or has neither format, a name is unknown, a score is NaN or out of range, or
            times do not increase. The message names the frame.
    """
    try:
        with open_recording(path) as file:
            content = parse_json(file.read().decode("utf-8"), any_size=True, constants=True)
    except (OSError, ValueError, MemoryError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); give frames of blend shapes") from None
    frames = [content] if isinstance(content, dict) else content
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(
            f'{path}: is not a list of frames; give [{{"timestamp_ms": .., "blendshapes": {{name: score}}}}, ...]'
        )
    rows, found = np.zeros((len(frames), 52 + 6)), np.zeros(len(frames), dtype=bool)
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        scores, matrix = from_face_landmarker(frame, where) if "faceBlendshapes" in frame else _plain(frame, where)
        found[index] = scores is not None
        if scores is not None:
            rows[index, :52] = _row(scores, where)
        if matrix is not None:
            rotation = rotation_of(matrix[:3, :3])
            if rotation is None:
                raise UserError(f"{where}: its facial transformation matrix is not a rotation; correct or delete it")
            rows[index, 52:55] = axis_angle_from_matrix(rotation)
            rows[index, 55:] = _CENTIMETRE * matrix[:3, 3]
    if not found.any():
        raise UserError(f"{path}: no frame has a face; record it again")
    seconds = _seconds(frames, path)
    check_times(seconds, lambda index: f"{path}, frame {index}")
    fps, rows = resample_evenly(seconds, repeat_lost(rows, found))
    coefficients = rows[:, :52].astype(np.float32)
    head = rows[:, 52:].astype(np.float32)
    return Motion(fps, coefficients, gaze_of(coefficients), head[:, :3], head[:, 3:], int((~found).sum()))


def from_face_landmarker(frame: dict[str, Any], where: str) -> tuple[dict[str, Any] | None, np.ndarray | None]:
    """Scores by name and T_camera_face [4, 4] (centimetres, OpenGL axes) of the first face in a result.

    Either is None if the result does not have it.

    Raises:
        UserError: The result has another layout, or its matrix holds NaN or huge numbers.
    """
    try:
        faces, poses = frame["faceBlendshapes"], frame.get("facialTransformationMatrixes") or []
        scores = {entry["categoryName"]: entry["score"] for entry in faces[0]["categories"]} if faces else None
        matrix = np.array(poses[0]["data"], dtype=np.float64).reshape(4, 4).T if poses else None
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(f"{where}: does not have the layout of a FaceLandmarker result ({_short(error)})") from None
    if matrix is not None and not (np.abs(matrix) < _MAX_MATRIX_ENTRY).all():
        raise UserError(f"{where}: its facial transformation matrix contains NaN or huge numbers; correct or delete it")
    return scores, matrix


def _plain(frame: dict[str, Any], where: str) -> tuple[dict[str, Any] | None, None]:
    scores = frame.get("blendshapes")
    if "blendshapes" not in frame or not (scores is None or isinstance(scores, dict)):
        raise UserError(f'{where}: has no "blendshapes": {{name: score}} (null if no face was found)')
    return scores, None


def _row(scores: dict[str, Any], where: str) -> np.ndarray:
    row = np.zeros(52)
    for name, score in scores.items():
        if name == _NO_EXPRESSION:
            continue
        if name not in _INDEX:
            near = difflib.get_close_matches(str(name), ARKIT_NAMES, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise UserError(f"{where}: there is no blend shape {_short(name)}{hint}")
        is_number = isinstance(score, (int, float)) and not isinstance(score, bool)
        if not is_number or not MIN_COEFFICIENT <= score <= MAX_COEFFICIENT:
            raise UserError(f"{where}: {name} is {_short(score)}; scores go from 0 to 1")
        row[_INDEX[name]] = score
    return row


def _seconds(frames: list[dict[str, Any]], path: Path) -> np.ndarray:
    """Times of the frames in seconds. If no frame has a time, there are 30 frames per second."""
    stamps = [frame.get("timestamp_ms", frame.get("timestampMs")) for frame in frames]
    if all(stamp is None for stamp in stamps):
        return np.arange(len(frames)) / _DEFAULT_FPS
    for index, stamp in enumerate(stamps):
        if isinstance(stamp, bool) or not isinstance(stamp, (int, float)) or not abs(stamp) < _MAX_MILLISECONDS:
            raise UserError(f"{path}, frame {index}: timestamp_ms is {_short(stamp)}; give every frame a number")
        if index and stamp <= stamps[index - 1]:  # pyright: ignore[reportOperatorIssue]
            raise UserError(f"{path}, frame {index}: its timestamp_ms does not come after the one before")
    return np.array(stamps, dtype=np.float64) / 1000


def _short(value: object) -> str:
    """A value as messages show it."""
    try:
        return shorten(repr(value))
    except ValueError:  # Python refuses to print integers with thousands of digits.
        return f"a number of type {type(value).__name__} with thousands of digits"
