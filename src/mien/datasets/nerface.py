"""NeRFace: pictures, cameras and a clean plate. Its 76 coefficients belong to a model that nobody can ship.

Its cameras have a negative focal length, because its world is mirrored. They become proper cameras of a world that is
mirrored back. Its unit is not the metre, so the poses are kept beside the capture and not used.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mien.datasets import content
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.disk.reading import listed
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.face.model import FaceModel

_CLIPS = ("train", "test")
"""The parts that become sequences. The five pictures of val are left out, because nothing tells their place in time."""
_FPS = 25.0
_EXPRESSIONS = 76
_ENDINGS = (".png", ".jpg", "")


def _file(path: Path, part: str) -> Path:
    return path / f"transforms_{part}.json"


def _recognises(path: Path) -> str | None:
    head = content.sniff(_file(path, "train"))
    return "a person of NeRFace" if b'"intrinsics"' in head and b'"expression"' in head else None


def _clips(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The frames of each clip, in the order of the files."""
    files = {clip: _file(path, clip) for clip in _CLIPS}
    return {clip: content.read_frames(file) for clip, file in files.items() if clip == "train" or file.exists()}


def _in_time(path: Path, frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The training frames in the order of time, by index_map.npy.

    A row of it has the number of a picture of the whole clip, and its number among the training pictures or -1.
    """
    file = path / "index_map.npy"
    if not file.exists():
        return frames
    index = content.read_npy(file)
    if index.ndim != 2 or index.shape[1] != 2 or index.dtype.kind not in "iuf":
        raise UserError(f"{file}: has the shape {list(index.shape)}, not [n, 2]; {content.REMEDY}")
    rows = index[index[:, 1] >= 0]
    order = rows[rows[:, 0].argsort(kind="stable"), 1]
    if sorted(order.tolist()) != list(range(len(frames))):
        raise UserError(f"{file}: does not list each of the {len(frames)} training pictures once; {content.REMEDY}")
    return [frames[int(number)] for number in order]


def _survey(path: Path) -> Findings:
    clips = _clips(path)
    missing = ["the basis of its 76 coefficients, which is not published: use `mien track`, or for HeadGaS "
               "--face-model coefficients-76",
               "the place in time of val's pictures, which are left out"]  # fmt: skip
    if not (path / "index_map.npy").exists():
        missing.append("index_map.npy, so the order of the training pictures in time is not known")
    if not _plates(path):
        missing.append("bg, the picture of the empty scene: mattes are less exact without it")
    if "test" not in clips:
        missing.append("transforms_test.json")
    return Findings(
        tuple(Clip(name, len(frames)) for name, frames in clips.items()), None,
        "the clip test is held out" if "test" in clips else None, tuple(missing),
    )  # fmt: skip


def _plates(path: Path) -> list[Path]:
    return listed(path, "bg/*.png")


def camera_from_nerface(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics in pixels. Rays go through whole pixels there, so half a pixel is added to the centre."""
    from mien.datasets.flame_poses import pinhole

    fx, fy, cx, cy = intrinsics
    return pinhole(abs(fx), abs(fy), cx * size[0] + 0.5, cy * size[1] + 0.5)


def viewmats_from_nerface(poses: np.ndarray, fx: float) -> np.ndarray:
    """World-to-camera matrices [t, 4, 4] with OpenCV's axes, from camera-to-world matrices with OpenGL's.

    If fx is negative, the world is mirrored at x = 0, which makes proper cameras of mirrored ones.
    """
    mirrored = fx < 0
    turn = -np.eye(3) if mirrored else np.diag([1.0, -1.0, -1.0])
    mirror = np.diag([-1.0, 1.0, 1.0]) if mirrored else np.eye(3)
    whole = np.tile(np.eye(4), (len(poses), 1, 1))
    whole[:, :3, :3] = mirror @ poses[:, :3, :3] @ turn
    whole[:, :3, 3] = poses[:, :3, 3] @ mirror
    return np.linalg.inv(whole)


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of
    from mien.datasets.pictures import read_one_camera
    from mien.datasets.sequences import filmed_sequence
    from mien.training.settings.splits import OwnSplit

    plate = next(iter(_plates(path)), None)
    if plate is not None:
        content.check_file_inside(path, plate)
    for name, given in _clips(path).items():
        file, frames = _file(path, name), _in_time(path, given) if name == "train" else given
        places = content.pictures_of(file, path, frames, _ENDINGS)
        intrinsics = content.numbers(file, content.read_object(file), "intrinsics", (4,))
        images, mattes = read_one_camera(places, name, None, plate)
        size = images.shape[3], images.shape[2]
        poses = content.stacked_poses(file, frames, "transform_matrix")
        expression = content.stacked(file, frames, "expression", (_EXPRESSIONS,))
        foreign = {"expression": expression, "head_to_camera": viewmats_from_nerface(poses, float(intrinsics[0]))}
        camera = {"0": camera_of(camera_from_nerface(intrinsics, size), FRONT, size)}
        sequence = filmed_sequence(path, name, images, mattes, camera, _FPS)
        yield replace(
            sequence,
            own_split=OwnSplit(((0, len(frames)),) if name == "test" else ()),
            foreign={name: array.astype(np.float32) for name, array in foreign.items()},
        )


def _read(path: Path, face_model: "FaceModel | None") -> Iterator[ReadSequence]:
    from mien.datasets.coefficients import on_coefficients

    return on_coefficients(path, _read_pictures(path), face_model)


NERFACE = Dataset(
    "nerface", "a person of NeRFace: transforms_train.json with intrinsics and expression", "sequences", _recognises,
    _read, _survey, _read_pictures,
)  # fmt: skip
