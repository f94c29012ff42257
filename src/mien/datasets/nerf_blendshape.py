"""NeRFBlendShape: pictures, MediaPipe's landmarks, a parsing of the head, and 46 coefficients.

Their basis is not published, so they are kept beside the capture, for methods and drivers that need only coefficients.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mien.datasets import content
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.disk.reading import read_bytes
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.face.model import FaceModel

_FILE = "transforms.json"
_FPS = 25.0
_TAIL = 500  # number of frames at the end that the authors hold out
_COEFFICIENTS = 46
_LANDMARKS = 478
_HEAD = (0, 0, 255)  # colour of the head in the parsing, as red, green and blue


def _recognises(path: Path) -> str | None:
    return "a person of NeRFBlendShape" if b'"exp_ori"' in content.sniff(path / _FILE) else None


def _frames(path: Path) -> tuple[dict[str, Any], list[tuple[int, dict[str, Any]]]]:
    """The json file, and its frames by the numbers of their pictures, in increasing order."""
    file = path / _FILE
    values = content.read_object(file)
    found: dict[int, dict[str, Any]] = {}
    for number, frame in enumerate(content.frames_of(file, values)):
        img_id = frame.get("img_id")
        if type(img_id) is not int or img_id < 0 or img_id in found:
            raise UserError(f"{file}: frame {number} has no 'img_id' of its own; {content.REMEDY}")
        found[img_id] = frame
    return values, sorted(found.items())


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


def _read_landmarks(root: Path, path: Path) -> np.ndarray:
    """The 478 points of a .lms file in pixels; NaN if the file is missing."""
    if not content.is_file_inside(root, path):
        return np.full((_LANDMARKS, 2), np.nan)
    try:
        points = np.array(read_bytes(path, 1 << 20).decode("ascii").split(), np.float64).reshape(-1, 2)
    except (OSError, ValueError):
        points = np.zeros((0, 2))
    if points.shape != (_LANDMARKS, 2) or not np.abs(points).max() < 1e6:
        raise UserError(f"{path}: does not hold {_LANDMARKS} points; {content.REMEDY}")
    return points


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of, pinhole, viewmats_from_opengl
    from mien.datasets.pictures import read_one_camera, read_picture
    from mien.datasets.sequences import filmed_sequence
    from mien.training.settings.splits import OwnSplit

    file = path / _FILE
    values, numbered = _frames(path)
    frames = [frame for _, frame in numbered]
    folder = "ori_imgs" if (path / "ori_imgs").is_dir() else "head_imgs"
    places = [content.inner(file, path, f"{folder}/{number}", (".jpg", ".png")) for number, _ in numbered]

    def matte(timestep: int, opacity: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
        classes = read_picture(content.inner(file, path, f"parsing/{numbered[timestep][0]}", (".png",)), size)[0]
        return (classes == _HEAD).all(-1).astype(np.uint8) * 255

    images, mattes = read_one_camera(places, path.name, matte if (path / "parsing").is_dir() else None)
    landmarks = np.stack([_read_landmarks(path, place.with_suffix(".lms")) for place in places])[:, None]
    given = landmarks.astype(np.float32) if np.isfinite(landmarks).any() else None
    fx, fy, cx, cy = content.scalars(file, values, "fx", "fy", "cx", "cy")
    # Rays go through whole pixels there, which are the corners of pixels here.
    camera = {"0": camera_of(pinhole(fx, fy, cx + 0.5, cy + 0.5), FRONT, (images.shape[3], images.shape[2]))}
    foreign = {
        "expression": content.stacked(file, frames, "exp_ori", (_COEFFICIENTS,)),
        "head_to_camera": viewmats_from_opengl(content.stacked_poses(file, frames, "transform_matrix")),
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
