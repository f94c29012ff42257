"""Layouts of json with blend shapes, by program. Each function turns one layout into `Recorded`.

The plain layout is a list of frames, {"timestamp_ms": 0, "blendshapes": {"jawOpen": 0.3, ...}}. Missing names are 0.

MediaPipe's FaceLandmarker gives results, one or a list of them, to which the user adds a time. JavaScript names them
{"faceBlendshapes": [{"categories": [{"categoryName": .., "score": ..}]}], "facialTransformationMatrixes": [{"data": [16
numbers, column by column]}]}, and Python {"face_blendshapes": [[{"category_name": .., "score": ..}]],
"facial_transformation_matrixes": [4 rows of 4 numbers]}. Only the first face counts.

BEAT and LAM write {"names": [..], "frames": [{"weights": [..], "time": seconds}]}.

Audio2Face writes {"exportFps": 60, "facsNames": [..], "weightMat": [[..], ..]}.

Azure's speech service sends pieces of a film with 60 frames a second, {"FrameIndex": 30, "BlendShapes": [[55 numbers],
..]}: ARKit's 52 with left before right, then the rolls of the head and of both eyes, whose unit is not documented.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mien.driving.motion import ARKIT_NAMES, shorten
from mien.driving.sources.sides import AUDIO2FACE, AZURE_SPEECH, FACE_LANDMARKER, NAMED_WEIGHTS, PLAIN, Sides
from mien.errors import UserError

Scores = dict[str, Any]
_MILLISECOND_KEYS, _SECOND_KEYS = ("timestamp_ms", "timestampMs"), ("time",)
_BLENDSHAPES = ("faceBlendshapes", "face_blendshapes")
_MATRICES = ("facialTransformationMatrixes", "facial_transformation_matrixes")
_CATEGORY = ("categoryName", "category_name")
_MAX_MATRIX_ENTRY = 1e6
"""Largest number in a transformation matrix (translations are in centimetres)."""
_MIN_FPS, _MAX_FPS = 1.0, 500.0
_AZURE_FPS, _AZURE_ROLLS = 60.0, 3
_AZURE_NAMES = tuple(
    {"jawRight": "jawLeft", "jawLeft": "jawRight", "mouthRight": "mouthLeft", "mouthLeft": "mouthRight"}.get(name, name)
    for name in ARKIT_NAMES
)
_MAX_FRAMES = 10 * 60 * 60 * 60
"""Most frames of Azure's pieces: ten hours."""
_LEAST_KNOWN = 0.5
"""Least share of ARKit's names among the names of a file whose other names are left out."""


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
    """Name of the times."""
    units: float
    """Units of the times in a second."""
    fps: float | None
    """Frames per second, if the file states them."""
    sides: Sides
    """The sides of its names."""
    notes: tuple[str, ...] = ()
    """Lines for the user."""


def recorded(content: Any, path: Path) -> Recorded:
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
    scores, matrices, landmarker = [], [], False
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        of_landmarker = _of(frame, _BLENDSHAPES) is not None
        landmarker |= of_landmarker
        found, matrix = from_face_landmarker(frame, where) if of_landmarker else (_plain(frame, where), None)
        scores.append(found)
        matrices.append(matrix)
    key, units, times = _times(frames)
    return Recorded(scores, matrices, times, key, units, None, FACE_LANDMARKER if landmarker else PLAIN)


def from_face_landmarker(frame: dict[str, Any], where: str) -> tuple[Scores | None, np.ndarray | None]:
    """Scores by name and T_camera_face [4, 4] (centimetres, OpenGL axes) of the first face in a result.

    Either is None if the result does not have it.
    """
    try:
        faces, poses = _of(frame, _BLENDSHAPES), _of(frame, _MATRICES) or []
        scores, matrix = None, None
        if faces:
            entries = faces[0]["categories"] if isinstance(faces[0], dict) else faces[0]
            scores = {_category(entry): entry["score"] for entry in entries}
        if poses and isinstance(poses[0], dict):
            matrix = np.array(poses[0]["data"], dtype=np.float64).reshape(4, 4).T
        elif poses:
            matrix = np.array(poses[0], dtype=np.float64).reshape(4, 4)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(f"{where}: does not have the layout of a FaceLandmarker result ({short(error)})") from None
    if matrix is not None and not (np.abs(matrix) < _MAX_MATRIX_ENTRY).all():
        raise UserError(f"{where}: its facial transformation matrix contains NaN or huge numbers; correct or delete it")
    return scores, matrix


def _category(entry: dict[str, Any]) -> str:
    return entry[next((key for key in _CATEGORY if key in entry), _CATEGORY[0])]


def _of(frame: dict[str, Any], keys: Iterable[str]) -> Any:
    """The value of the first key that the frame has."""
    return next((frame[key] for key in keys if key in frame), None)


def _times(frames: list[Any]) -> tuple[str, float, list[Any]]:
    """The name of the times, their units in a second, and the time of each frame."""
    has_milliseconds = any(_of(frame, _MILLISECOND_KEYS) is not None for frame in frames)
    keys, units = (_MILLISECOND_KEYS, 1000.0) if has_milliseconds else (_SECOND_KEYS, 1.0)
    return keys[0], units, [_of(frame, keys) for frame in frames]


def _plain(frame: dict[str, Any], where: str) -> Scores | None:
    scores = frame.get("blendshapes")
    if "blendshapes" not in frame or not (scores is None or isinstance(scores, dict)):
        raise UserError(f'{where}: has no "blendshapes": {{name: score}} (null if no face was found)')
    return scores


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
    return Recorded(scores, [None] * len(frames), times, key, units, fps, NAMED_WEIGHTS, notes)


def _audio2face(content: dict[str, Any], path: Path) -> Recorded:
    rows = content["weightMat"]
    if not isinstance(rows, list) or not rows:
        raise UserError(f'{path}: "weightMat" is not a list of frames; export it from Audio2Face again')
    names, notes = _known_names(_of(content, ("facsNames", "faceNames")), path)
    scores = [_by_name(names, row, f"{path}, frame {index}") for index, row in enumerate(rows)]
    fps, nothing = _rate(content.get("exportFps"), "exportFps", path), [None] * len(rows)
    return Recorded(scores, list(nothing), nothing, _SECOND_KEYS[0], 1.0, fps, AUDIO2FACE, notes)


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
    return Recorded(scores, [None] * len(scores), times, "FrameIndex", 1.0, None, AZURE_SPEECH, notes)


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
    if len(others) > (1 - _LEAST_KNOWN) * len(names) or not names:
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
        own = name.replace("Left", "_L").replace("Right", "_R") if name.startswith(_HALVES) else name
        for spelling in (name, own):
            places |= {spelling: index, spelling[0].upper() + spelling[1:]: index}
    return places


_HALVES = tuple(
    name.removesuffix("Left") for name in ARKIT_NAMES if name.endswith("Left") and name not in ("jawLeft", "mouthLeft")
)
"""Starts of the names that exist once for each half of the face."""
_INDEX = _spellings()


def short(value: object) -> str:
    """A value as messages show it."""
    try:
        return shorten(repr(value))
    except ValueError:  # Python refuses to print integers with thousands of digits.
        return f"a number of type {type(value).__name__} with thousands of digits"
