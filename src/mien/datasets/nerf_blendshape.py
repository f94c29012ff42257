"""NeRFBlendShape: pictures, MediaPipe's landmarks, a parsing of the head, and 46 coefficients.

Their basis is not published, so they are kept beside the capture, for methods and drivers that need only coefficients.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mien.datasets.content import (
    REMEDY,
    frames_of,
    inner,
    is_file_inside,
    numbers,
    read_object,
    rotation_part,
    sniff,
)
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from mien.face.model import FaceModel

_FILE = "transforms.json"
_FPS = 25.0
_TAIL = 500
"""Number of frames at the end that the authors hold out."""
_COEFFICIENTS = 46
_LANDMARKS = 478
_HEAD = (0, 0, 255)
"""Colour of the head in the parsing, as red, green and blue."""
_MAX_LANDMARK_BYTES = 1 << 20


def _recognises(path: Path) -> str | None:
    return "a person of NeRFBlendShape" if b'"exp_ori"' in sniff(path / _FILE) else None


def _frames(path: Path) -> tuple[dict[str, Any], list[tuple[int, dict[str, Any]]]]:
    """The json file, and its frames by the numbers of their pictures, in increasing order."""
    file = path / _FILE
    content = read_object(file)
    found: dict[int, dict[str, Any]] = {}
    for number, frame in enumerate(frames_of(file, content)):
        img_id = frame.get("img_id")
        if type(img_id) is not int or img_id < 0 or img_id in found:
            raise UserError(f"{file}: frame {number} has no 'img_id' of its own; {REMEDY}")
        found[img_id] = frame
    return content, sorted(found.items())


def _survey(path: Path) -> Findings:
    frames = _frames(path)[1]
    missing = ["the basis of its 46 coefficients, which is not published: use `mien track`, or for HeadGaS "
               "--face-model coefficients-46"]  # fmt: skip
    if not (path / "parsing").is_dir():
        missing.append("parsing: mattes are made by mien")
    long = len(frames) > _TAIL
    if not long:
        missing.append(f"a split: {len(frames)} frames are too few for its last {_TAIL}")
    split = f"the last {_TAIL} frames are held out" if long else None
    return Findings((Clip(path.name, len(frames)),), None, split, tuple(missing))


def viewmats_from_nerf_blendshape(poses: "np.ndarray") -> "np.ndarray":
    """World-to-camera matrices [t, 4, 4] with OpenCV's axes, from camera-to-world matrices with OpenGL's."""
    import numpy as np

    return np.linalg.inv(poses @ np.diag([1.0, -1.0, -1.0, 1.0]))


def _read_landmarks(path: Path) -> "np.ndarray":
    """The 478 points of a .lms file in pixels; NaN if the file is missing."""
    import numpy as np

    from mien.disk.reading import read_bytes

    try:
        text = read_bytes(path, _MAX_LANDMARK_BYTES).decode("ascii")
        points = np.array(text.split(), np.float64).reshape(-1, 2)
    except FileNotFoundError:
        return np.full((_LANDMARKS, 2), np.nan)
    except (OSError, ValueError):
        points = np.zeros((0, 2))
    if points.shape != (_LANDMARKS, 2) or not np.abs(points).max() < 1e6:
        raise UserError(f"{path}: does not hold {_LANDMARKS} points; {REMEDY}")
    return points


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    import numpy as np

    from mien.datasets.flame_poses import FRONT, camera_of, pinhole
    from mien.datasets.matting import fill_mattes
    from mien.datasets.pictures import collect, read_picture
    from mien.datasets.sequences import filmed_sequence
    from mien.training.settings.splits import OwnSplit

    file = path / _FILE
    content, frames = _frames(path)
    folder = "ori_imgs" if (path / "ori_imgs").is_dir() else "head_imgs"
    places = [inner(file, path, f"{folder}/{number}", (".jpg", ".png")) for number, _ in frames]
    parsing = (path / "parsing").is_dir()
    first = read_picture(places[0])[0]
    size = first.shape[1], first.shape[0]

    def read(timestep: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
        colors = read_picture(places[timestep], size)[0]
        if not parsing:
            return colors, np.zeros((size[1], size[0]), np.uint8)
        classes = read_picture(inner(file, path, f"parsing/{frames[timestep][0]}", (".png",)), size)[0]
        return colors, (classes == _HEAD).all(-1).astype(np.uint8) * 255

    images, mattes = collect(len(places), 1, size, read, f"read {path.name}")
    if not parsing:
        fill_mattes(images, mattes)
    marks = [place.with_suffix(".lms") for place in places]
    landmarks = np.stack([_read_landmarks(mark) if is_file_inside(path, mark) else _read_landmarks(path / "none.lms")
                          for mark in marks])[:, None]  # fmt: skip
    given = landmarks.astype(np.float32) if np.isfinite(landmarks).any() else None
    fx, fy, cx, cy = (float(numbers(file, content, name, ())) for name in ("fx", "fy", "cx", "cy"))
    # Rays go through whole pixels there, which are the corners of pixels here.
    camera = {"0": camera_of(pinhole(fx, fy, cx + 0.5, cy + 0.5), FRONT, size)}
    poses = np.stack([rotation_part(file, "transform_matrix", numbers(file, frame, "transform_matrix", (4, 4)))
                      for _, frame in frames])  # fmt: skip
    foreign = {
        "expression": np.stack([numbers(file, frame, "exp_ori", (_COEFFICIENTS,)) for _, frame in frames]),
        "head_to_camera": viewmats_from_nerf_blendshape(poses),
    }
    count = len(frames)
    sequence = filmed_sequence(path, path.name, images, mattes, camera, _FPS, given)
    yield replace(
        sequence,
        own_split=OwnSplit(((count - _TAIL, count),)) if count > _TAIL else None,
        foreign={name: array.astype(np.float32) for name, array in foreign.items()},
    )


def _read(path: Path, face_model: "FaceModel | None") -> Iterator[ReadSequence]:
    from mien.datasets.coefficients import on_coefficients

    return on_coefficients(path, _read_pictures(path), face_model)


NERF_BLENDSHAPE = Dataset(
    "nerf-blendshape", "a person of NeRFBlendShape: transforms.json with exp_ori", "sequences", _recognises, _read,
    _survey, _read_pictures,
)  # fmt: skip
