"""Small recordings in every layout that mien reads, made from a list of coefficients for each frame."""

import json
from collections.abc import Callable
from pathlib import Path

from mien.driving.live_link_face import EYES, HEAD
from mien.driving.motion import ARKIT_NAMES

Frames = list[dict[str, float]]
COLUMNS = ["Timecode", "BlendshapeCount", *(name[0].upper() + name[1:] for name in ARKIT_NAMES), *HEAD, *EYES]
STILL = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -40], [0, 0, 0, 1]]


def row(timecode: str, **values: float | str) -> list[str]:
    return [timecode, "61", *(str(values.get(name, 0)) for name in COLUMNS[2:])]


def write_csv(path: Path, *rows: list[str], columns: list[str] | None = None) -> Path:
    path.write_text("\n".join(",".join(cells) for cells in (columns or COLUMNS, *rows)) + "\n")
    return path


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def live_link_face(folder: Path, frames: Frames) -> Path:
    rows = []
    for index, scores in enumerate(frames):
        seconds, frame = divmod(2 * index, 60)
        named = {name[0].upper() + name[1:]: score for name, score in scores.items()}
        rows.append(row(f"12:00:{seconds:02d}:{frame:02d}.451", **named))
    return write_csv(folder / "take.csv", *rows)


def plain(folder: Path, frames: Frames) -> Path:
    listed = [{"timestamp_ms": 33 * index, "blendshapes": scores} for index, scores in enumerate(frames)]
    return write_json(folder / "plain.json", listed)


def landmarker_in_javascript(folder: Path, frames: Frames) -> Path:
    return write_json(folder / "javascript.json", [
        {
            "timestampMs": 33 * index,
            "faceBlendshapes": [{"categories": [{"categoryName": n, "score": s} for n, s in scores.items()]}],
            "facialTransformationMatrixes": [
                {"rows": 4, "columns": 4, "data": [STILL[r][c] for c in range(4) for r in range(4)]}
            ],
        }
        for index, scores in enumerate(frames)
    ])  # fmt: skip


def landmarker_in_python(folder: Path, frames: Frames) -> Path:
    return write_json(folder / "python.json", [
        {
            "timestamp_ms": 33 * index,
            "face_blendshapes": [[{"index": 1, "score": s, "category_name": n} for n, s in scores.items()]],
            "facial_transformation_matrixes": [STILL],
        }
        for index, scores in enumerate(frames)
    ])  # fmt: skip


def named_weights(folder: Path, frames: Frames) -> Path:
    """Write LAM's layout, which is BEAT's with metadata."""
    names = sorted(ARKIT_NAMES)
    weights = [[scores.get(name, 0.0) for name in names] for scores in frames]
    listed = [{"weights": one, "time": index / 30, "rotation": []} for index, one in enumerate(weights)]
    return write_json(folder / "lam.json", {"names": names, "metadata": {"fps": 30.0}, "frames": listed})


def audio2face(folder: Path, frames: Frames) -> Path:
    names = [name[0].upper() + name[1:] for name in ARKIT_NAMES]
    weights = [[scores.get(name, 0.0) for name in ARKIT_NAMES] for scores in frames]
    counts = {"numPoses": len(names), "numFrames": len(weights)}
    content = {"exportFps": 30, **counts, "facsNames": names, "weightMat": weights, "trackPath": "a.wav"}
    return write_json(folder / "audio.json", content)


def table(key: str, step: float) -> Callable[[Path, Frames], Path]:
    """Return what writes a csv with ARKit's names and one column of times."""

    def write(folder: Path, frames: Frames) -> Path:
        rows = [
            [str(step * at), *(str(scores.get(name, 0)) for name in ARKIT_NAMES)] for at, scores in enumerate(frames)
        ]
        return write_csv(folder / f"{key}.csv", *rows, columns=[key, *ARKIT_NAMES])

    return write


def azure_speech(folder: Path, frames: Frames) -> Path:
    """Write a piece for each frame. Left comes before right in all pairs of Azure's list."""
    pairs = {"jawRight": "jawLeft", "mouthRight": "mouthLeft"}
    swapped = pairs | {left: right for right, left in pairs.items()}
    rows = [[*(scores.get(swapped.get(name, name), 0) for name in ARKIT_NAMES), 0, 0, 0] for scores in frames]
    pieces = [{"FrameIndex": 2 * at, "BlendShapes": [row]} for at, row in enumerate(rows)]
    return write_json(folder / "speech.json", pieces)


LAYOUTS: dict[str, list[Callable[[Path, Frames], Path]]] = {
    "Live Link Face (.csv)": [live_link_face],
    "table without a timecode (.csv)": [table("timestamp_ms", 33), table("time", 1 / 30)],
    "plain list (.json)": [plain],
    "MediaPipe's FaceLandmarker (.json)": [landmarker_in_javascript, landmarker_in_python],
    "BEAT, LAM (.json)": [named_weights],
    "Audio2Face (.json)": [audio2face],
    "Azure speech (.json)": [azure_speech],
}
"""What writes the layouts of each source of the table of sides."""
