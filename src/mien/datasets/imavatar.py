"""IMavatar, PointAvatar, MonoGaussianAvatar and SplattingAvatar: clips with a flame_params.json.

FLAME 2020 with 100 identity and 50 expression coefficients, in a world that is four times as large. Cameras have
OpenGL-like axes and a first intrinsic that is negative, which together give no mirror image.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mien.datasets import content
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.face.model import FaceModel
    from mien.face.params import FaceParams

_FILE = "flame_params.json"
_VERSION = "FLAME 2020 (generic_model.pkl)"
_FPS = 25.0
_SCALE = 4.0  # size of the data set's world in metres' units: a head is four times as large
_OLD_SIZE = 512  # width of the pictures of the old format, whose intrinsics are in pixels
_TEST = ("MVI_1812", "MVI_1802", "test", "wlz0318_test")
"""Clips that the authors hold out as a whole. The other clips of the same subject are trained on."""
_TAIL = 350  # number of frames at the end that SplattingAvatar holds out of its one clip
_ENDINGS = (".png", ".jpg", "")
_CLOTHES = (15, 16)
"""Classes of `semantic` that MonoGaussianAvatar leaves out of its second set of figures: necklace and cloth."""


@dataclass(frozen=True)
class _Clip:
    file: Path
    content: dict[str, Any]
    frames: list[dict[str, Any]]

    @property
    def name(self) -> str:
        return self.file.parent.name


def _files(path: Path) -> list[Path]:
    """The json files of the clips: in the folder itself, in its clips, or with the subject's name twice."""
    for pattern in (_FILE, f"*/{_FILE}", f"*/*/{_FILE}"):
        found = sorted(each for each in path.glob(pattern) if b'"world_mat"' in content.sniff(each))
        if found:
            return found
    return []


def _recognises(path: Path) -> str | None:
    if not path.is_dir():
        return None
    count = len(_files(path))
    return f"a subject of IMavatar's layout ({_FILE} of {count} clip{'s' * (count != 1)})" if count else None


def _clips(path: Path) -> list[_Clip]:
    contents = {file: content.read_object(file) for file in _files(path)}
    clips = [_Clip(file, values, content.frames_of(file, values)) for file, values in contents.items()]
    if not clips:
        raise UserError(f"{path}: has no {_FILE} with world_mat; {content.REMEDY}")
    names = [clip.name for clip in clips]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"{path}: has two clips {twice!r}, of several subjects; import each subject by itself")
    return clips


def _held_out(clips: list[_Clip]) -> dict[str, tuple[tuple[int, int], ...]]:
    """The ranges of timesteps that are held out, by the clip's name. It is empty if no split is known."""
    tests = [clip.name for clip in clips if clip.name in _TEST]
    if tests and len(tests) < len(clips):
        return {clip.name: ((0, len(clip.frames)),) if clip.name in tests else () for clip in clips}
    if len(clips) == 1 and len(clips[0].frames) > _TAIL and not tests:
        count = len(clips[0].frames)
        return {clips[0].name: ((count - _TAIL, count),)}
    return {}


def _survey(path: Path) -> Findings:
    clips = _clips(path)
    held, split = _held_out(clips), None
    whole = [clip.name for clip in clips if held.get(clip.name) == ((0, len(clip.frames)),)]
    if whole:
        split = f"the clip {', '.join(whole)} is held out"
    elif held:
        split = f"the last {_TAIL} frames are held out (SplattingAvatar)"
    missing = [] if held else ["a split: no clip has the name of a test clip"]
    bare = [clip.name for clip in clips if not (clip.file.parent / "semantic").is_dir()]
    if bare:
        missing.append(f"semantic of {', '.join(bare)}: figures without clothes need it")
    return Findings(tuple(Clip(clip.name, len(clip.frames)) for clip in clips), "FLAME 2020", split, tuple(missing))


def camera_from_imavatar(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics in pixels from the four of the file, which are relative to the picture's size.

    Rays go through whole pixels there, which are the corners of pixels here, so half a pixel is added to the centre.
    Files of the old format have pixels of pictures of 512x512; their fourth number is above 1.
    """
    from mien.datasets.flame_poses import pinhole

    fx, fy, cx, cy = intrinsics / _OLD_SIZE if intrinsics[3] > 1 else intrinsics
    width, height = size
    return pinhole(abs(fx) * width, abs(fy) * height, cx * width + 0.5, cy * height + 0.5)


def _pictures(clip: _Clip, root: Path) -> tuple[np.ndarray, np.ndarray]:
    from mien.datasets.pictures import read_matte, read_one_camera

    places = content.pictures_of(clip.file, root, clip.frames, _ENDINGS)

    def matte(timestep: int, opacity: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
        name = f"mask/{places[timestep].name}"
        if opacity is not None and not (clip.file.parent / name).exists():
            return opacity
        return read_matte(content.inner(clip.file, root, name), size)

    return read_one_camera(places, clip.name, matte)


def _clothes(clip: _Clip, root: Path, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Packed masks of clothes by the pictures of classes; nothing if the clip has none."""
    from mien.datasets.pictures import read_matte
    from mien.training.footage.clothes import packed_clothes

    if not (clip.file.parent / "semantic").is_dir():
        return {}
    masks = []
    for place in content.pictures_of(clip.file, root, clip.frames, _ENDINGS):
        classes = read_matte(content.inner(clip.file, root, f"semantic/{place.with_suffix('.png').name}"), size)
        masks.append(packed_clothes(np.isin(classes, _CLOTHES)[None]))
    return {name: np.concatenate([mask[name] for mask in masks]) for name in masks[0]}


def _face(clip: _Clip, model: "FaceModel") -> "FaceParams":
    from mien.datasets.flame_poses import carried, face_of_flame

    file, frames = clip.file, clip.frames
    poses, mats = content.stacked(file, frames, "pose", (15,)), content.stacked_poses(file, frames, "world_mat", (3, 4))
    arrays = {
        "shape": content.numbers(file, clip.content, "shape_params", (None,)),
        "expr": content.stacked(file, frames, "expression", (50,)),
        "rotation": poses[:, :3], "neck_pose": poses[:, 3:6], "jaw_pose": poses[:, 6:9], "eyes_pose": poses[:, 9:],
    }  # fmt: skip
    # The cameras' axes are those of the world of `flame_poses.FRONT`, because OpenCV's axes are turned twice.
    return carried(face_of_flame(file, model, arrays), mats[:, :3, :3], mats[:, :3, 3] / _SCALE)


def _read(path: Path, face_model: "FaceModel | None" = None, *, tracked: bool = True) -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of, needed_flame
    from mien.datasets.sequences import sequence_of
    from mien.training.settings.splits import OwnSplit

    model, clips = needed_flame(path, face_model, _VERSION) if tracked else None, _clips(path)
    held = _held_out(clips)
    for clip in clips:
        face = None if model is None else (model, _face(clip, model))
        images, mattes = _pictures(clip, path)
        size = images.shape[3], images.shape[2]
        K = camera_from_imavatar(content.numbers(clip.file, clip.content, "intrinsics", (4,)), size)
        camera = {"0": camera_of(K, FRONT, size)}
        sequence = sequence_of(clip.file, clip.name, (images, mattes), camera, _FPS, face, _VERSION)
        split = OwnSplit(held[clip.name]) if held else None
        yield replace(sequence, own_split=split, foreign=_clothes(clip, path, size))


IMAVATAR = Dataset(
    "imavatar", "a subject of IMavatar, PointAvatar, MonoGaussianAvatar or SplattingAvatar with flame_params.json",
    "sequences", _recognises, _read, _survey, partial(_read, tracked=False),
)  # fmt: skip
