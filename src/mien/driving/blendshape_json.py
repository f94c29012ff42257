"""Blend shapes as json, in the layouts of several programs. Each function turns one layout into `Recorded`.

The plain layout is a list of frames, {"timestamp_ms": 0, "blendshapes": {"jawOpen": 0.3, ...}}. Missing names are 0.
Times are in milliseconds as "timestamp_ms" (or "timestampMs") and in seconds as "time". A frame without a face repeats
the frame before it.

MediaPipe's FaceLandmarker gives results, one or a list of them, to which the user adds a time. JavaScript names them
{"faceBlendshapes": [{"categories": [{"categoryName": .., "score": ..}]}], "facialTransformationMatrixes": [{"data": [16
numbers, column by column]}]}, and Python {"face_blendshapes": [[{"category_name": .., "score": ..}]],
"facial_transformation_matrixes": [4 rows of 4 numbers]}. Only the first face counts. Matrices are in centimetres, with
OpenGL axes.

BEAT and LAM write {"names": [..], "frames": [{"weights": [..], "time": seconds}]}.

Audio2Face writes {"exportFps": 60, "facsNames": [..], "weightMat": [[..], ..]}.

Azure's speech service sends pieces of a film with 60 frames a second, {"FrameIndex": 30, "BlendShapes": [[55 numbers],
..]}: ARKit's 52 with left before right, then the rolls of the head and of both eyes, whose unit is not documented.
"""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
    shorten,
)
from mien.errors import UserError
from mien.runtime.rotation import axis_angle_from_matrix, rotation_of

Scores = dict[str, Any]
_MILLISECOND_KEYS, _SECOND_KEYS = ("timestamp_ms", "timestampMs"), ("time",)
_BLENDSHAPES = ("faceBlendshapes", "face_blendshapes")
_MATRICES = ("facialTransformationMatrixes", "facial_transformation_matrixes")
_MIN_FPS, _MAX_FPS = 1.0, 500.0
_AZURE_FPS, _AZURE_ROLLS = 60.0, 3
_AZURE_NAMES = tuple(
    {"jawRight": "jawLeft", "jawLeft": "jawRight", "mouthRight": "mouthLeft", "mouthLeft": "mouthRight"}.get(name, name)
    for name in ARKIT_NAMES
)
_MAX_FRAMES = 10 * 60 * 60 * 60  # of Azure's pieces: ten hours


@dataclass(frozen=True, eq=False)
class Recorded:
    """The frames of a recording, as its file has them."""

    scores: list[Scores | None]
    """Scores by name for each frame. None if it has no face."""
    matrices: list[np.ndarray | None]
    """T_camera_face [4, 4] for each frame (centimetres, OpenGL axes). None if it has none."""
    times: list[Any]
    """What each frame has as its time. None if it has none."""
    time_key: str
    units: float
    """Units of the times in a second."""
    fps: float | None = None
    """Frames per second, if the file states them."""
    notes: tuple[str, ...] = ()


def _recorded(content: Any, path: Path) -> Recorded:
    """The frames of a json file of any layout."""
    if isinstance(content, dict) and "weightMat" in content:
        return _audio2face(content, path)
    if isinstance(content, dict) and "names" in content and "frames" in content:
        return _named_weights(content, path)
    frames = [content] if isinstance(content, dict) else content
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(
            f'{path}: is not a list of frames; give [{{"timestamp_ms": .., "blendshapes": {{name: score}}}}, ...]'
        )
    if all("BlendShapes" in frame and "FrameIndex" in frame for frame in frames):
        return _azure_speech(frames, path)
    scores, matrices = [], []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        if _of(frame, _BLENDSHAPES) is not None:
            found, matrix = _from_face_landmarker(frame, where)
        else:
            found, matrix = frame.get("blendshapes"), None
            if "blendshapes" not in frame or not (found is None or isinstance(found, dict)):
                raise UserError(f'{where}: has no "blendshapes": {{name: score}} (null if no face was found)')
        scores.append(found)
        matrices.append(matrix)
    key, units, times = _times(frames)
    return Recorded(scores, matrices, times, key, units)


def _from_face_landmarker(frame: dict[str, Any], where: str) -> tuple[Scores | None, np.ndarray | None]:
    """Scores by name and T_camera_face [4, 4] (centimetres, OpenGL axes) of the first face, each if there is one."""
    try:
        faces, poses = _of(frame, _BLENDSHAPES), _of(frame, _MATRICES) or []
        scores, matrix = None, None
        if faces:
            entries = faces[0]["categories"] if isinstance(faces[0], dict) else faces[0]
            key = "category_name" if entries and "category_name" in entries[0] else "categoryName"
            scores = {entry[key]: entry["score"] for entry in entries}
        if poses and isinstance(poses[0], dict):
            matrix = np.array(poses[0]["data"], dtype=np.float64).reshape(4, 4).T
        elif poses:
            matrix = np.array(poses[0], dtype=np.float64).reshape(4, 4)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(f"{where}: does not have the layout of a FaceLandmarker result ({short(error)})") from None
    if matrix is not None and not (np.abs(matrix) < 1e6).all():
        raise UserError(f"{where}: its facial transformation matrix contains NaN or huge numbers; correct or delete it")
    return scores, matrix


def _of(frame: dict[str, Any], keys: Iterable[str]) -> Any:
    """The value of the first key that the frame has."""
    return next((frame[key] for key in keys if key in frame), None)


def _times(frames: list[Any]) -> tuple[str, float, list[Any]]:
    """The name of the times, their units in a second, and the time of each frame."""
    has_milliseconds = any(_of(frame, _MILLISECOND_KEYS) is not None for frame in frames)
    keys, units = (_MILLISECOND_KEYS, 1000.0) if has_milliseconds else (_SECOND_KEYS, 1.0)
    return keys[0], units, [_of(frame, keys) for frame in frames]


def _named_weights(content: dict[str, Any], path: Path) -> Recorded:
    """A file of BEAT or LAM."""
    frames, about = content["frames"], content.get("metadata")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f'{path}: "frames" is not a list of frames; give [{{"weights": [..], "time": seconds}}, ...]')
    names, notes = _known_names(content["names"], path)
    scores = [_by_name(names, frame.get("weights"), f"{path}, frame {index}") for index, frame in enumerate(frames)]
    if any(frame.get("rotation") for frame in frames):
        notes = (*notes, f'{path}: "rotation" is not read, so the head keeps still')
    key, units, times = _times(frames)
    fps = _rate(about.get("fps") if isinstance(about, dict) else None, "fps", path)
    return Recorded(scores, [None] * len(frames), times, key, units, fps, notes)


def _audio2face(content: dict[str, Any], path: Path) -> Recorded:
    rows = content["weightMat"]
    if not isinstance(rows, list) or not rows:
        raise UserError(f'{path}: "weightMat" is not a list of frames; export it from Audio2Face again')
    names, notes = _known_names(_of(content, ("facsNames", "faceNames")), path)
    scores = [_by_name(names, row, f"{path}, frame {index}") for index, row in enumerate(rows)]
    fps, nothing = _rate(content.get("exportFps"), "exportFps", path), [None] * len(rows)
    return Recorded(scores, list(nothing), nothing, _SECOND_KEYS[0], 1.0, fps, notes)


def _azure_speech(pieces: list[dict[str, Any]], path: Path) -> Recorded:
    scores: list[Scores | None] = []
    times: list[Any] = []
    rolls = False
    for number, piece in enumerate(pieces):
        first, rows = piece["FrameIndex"], piece["BlendShapes"]
        if isinstance(first, bool) or not isinstance(first, int) or not 0 <= first <= _MAX_FRAMES:
            raise UserError(f"{path}, piece {number}: FrameIndex is {short(first)}; give the number of its first frame")
        if not isinstance(rows, list):
            raise UserError(f'{path}, piece {number}: "BlendShapes" is not a list of frames; save it again')
        for index, row in enumerate(rows, first):
            if not isinstance(row, list) or len(row) not in (len(_AZURE_NAMES), len(_AZURE_NAMES) + _AZURE_ROLLS):
                raise UserError(f"{path}, frame {index}: is not a list of 55 numbers; correct or delete it")
            scores.append(dict(zip(_AZURE_NAMES, row, strict=False)))
            times.append(index / _AZURE_FPS)
            rolls |= any(row[len(_AZURE_NAMES) :])
    if not scores:
        raise UserError(f'{path}: its "BlendShapes" have no frames; save the events of blend shapes')
    notes = (f"{path}: the rolls of head and eyes are not read, so the head keeps still",) if rolls else ()
    return Recorded(scores, [None] * len(scores), times, "FrameIndex", 1.0, None, notes)


def _rate(value: Any, key: str, path: Path) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _MIN_FPS <= value <= _MAX_FPS:
        raise UserError(f"{path}: {key} is {short(value)}; give frames per second, from {_MIN_FPS:g} to {_MAX_FPS:g}")
    return float(value)


def _known_names(names: Any, path: Path) -> tuple[list[str | None], tuple[str, ...]]:
    """Names of ARKit by column, None for columns that are left out, and lines for the user."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{path}: has no list of names for its weights; export it again")
    known = [name if arkit_index(name) is not None else None for name in names]
    others = [name for name, kept in zip(names, known, strict=True) if kept is None]
    if len(others) > 0.5 * len(names) or not names:
        told = f", such as {short(others[0])}" if others else ""
        raise UserError(f"{path}: most of its names are not ARKit's{told}; export it with ARKit's 52 blend shapes")
    if not others:
        return known, ()
    told = ", ".join(map(short, others[:3])) + (", ..." if len(others) > 3 else "")
    return known, (f"{path}: {len(others)} of its {len(names)} names are not ARKit's and are left out ({told})",)


def _by_name(names: list[str | None], weights: Any, where: str) -> Scores | None:
    if weights is None:
        return None
    if not isinstance(weights, list) or len(weights) != len(names):
        count = len(weights) if isinstance(weights, list) else short(weights)
        raise UserError(f"{where}: has {count} weights for {len(names)} names; correct or delete it")
    return {name: weight for name, weight in zip(names, weights, strict=True) if name is not None}


def arkit_index(name: Any) -> int | None:
    """The place of a name in `ARKIT_NAMES`. It may begin with a capital letter, or end with Apple's own _L and _R."""
    return _INDEX.get(name) if isinstance(name, str) else None


def _spellings() -> dict[str, int]:
    places = {}
    for index, name in enumerate(ARKIT_NAMES):
        # Slides have no halves of the face, so Apple does not shorten their sides.
        is_half = name.endswith(("Left", "Right")) and name not in ("jawLeft", "jawRight", "mouthLeft", "mouthRight")
        own = name.replace("Left", "_L").replace("Right", "_R") if is_half else name
        for spelling in (name, own):
            places |= {spelling: index, spelling[0].upper() + spelling[1:]: index}
    return places


_INDEX = _spellings()


def short(value: object) -> str:
    """A value as messages show it."""
    try:
        return shorten(repr(value))
    except ValueError:  # Python refuses to print integers with thousands of digits.
        return f"a number of type {type(value).__name__} with thousands of digits"


_DEFAULT_FPS = 30.0


def read_blendshape_json(path: Path) -> Motion:
    """Read motion from blend shapes as json."""
    try:
        with open_recording(path) as file:
            content = parse_json(text_of(file.read()), any_size=True, constants=True)
    except (OSError, ValueError, MemoryError) as error:
        raise UserError(f"{path}: cannot be read as json ({error}); give frames of blend shapes") from None
    read = _recorded(content, path)
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
    coefficients = rows[:, :52].astype(np.float32)
    head = rows[:, 52:].astype(np.float32)
    notes = (*read.notes, *turned, *assumed, *said)
    return Motion(fps, coefficients, gaze_of(coefficients), head[:, :3], head[:, 3:], lost, notes)


def _row(scores: Scores, where: str) -> Float[np.ndarray, " 52"]:
    row = np.zeros(52)
    for name, score in scores.items():
        if name == "_neutral":
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
    """Fill in rotations and translations of heads. Returns a line for the user if the matrices are transposed."""
    # A matrix without translation says nothing about its form, so all matrices of the file decide together.
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
        rows[index, 55:] = 0.01 * upright[:3, 3]
    return (f"{path}: its facial transformation matrices are transposed, and are read so",) if transposed else ()


def _seconds(read: Recorded, path: Path) -> tuple[Float[np.ndarray, " t"], tuple[str, ...]]:
    """Times of the frames in seconds, and a line for the user if the file has none."""
    if all(time is None for time in read.times):
        known = read.fps is not None or len(read.times) < 2
        line = f'{path}: has no times ("timestamp_ms", or "time" in seconds), so 30 frames a second are assumed'
        return np.arange(len(read.times)) / (read.fps or _DEFAULT_FPS), () if known else (line,)
    for index, time in enumerate(read.times):
        if isinstance(time, bool) or not isinstance(time, (int, float)) or not abs(time) < 1e15:
            raise UserError(f"{path}, frame {index}: {read.time_key} is {short(time)}; give every frame a number")
    return np.array(read.times, dtype=np.float64) / read.units, ()
