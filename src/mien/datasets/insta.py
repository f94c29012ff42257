"""INSTA's data set and the folders of programs that lay its data out in other ways.

- INSTA: transforms.json, images (RGBA), and in some copies checkpoint.
- GaussianBlendshapes, RGBAvatar: images (RGBA), checkpoint. Pictures and checkpoints are paired by their numbers.
- images.HQ in place of images: the pictures are larger than those that were tracked, by a whole factor.
- GaussianBlendshapes' copies of NeRFBlendShape: images (RGB), image_mask/mask_NUMBER.png, checkpoint.
- metrical-tracker's output: input (RGB, without mattes), checkpoint. mien makes the mattes.
- FlashAvatar: imgs, alpha, and metrical-tracker/output/NAME/checkpoint, whose numbers are smaller by one.

Without checkpoints, only pictures and the camera are read: the release lacks jaw, eyes and identity.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mien.datasets import content
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.errors import UserError
from mien.machine.terminal import counted

if TYPE_CHECKING:
    from mien.face.model import FaceModel
    from mien.training.settings.splits import OwnSplit

_FPS = 25.0
TEST_FRAMES = {"INSTA": 350, "FlashAvatar": 500, "NeRFBlendShape": 500}
"""Number of frames at the end that the authors hold out."""
_TEST = "transforms_test.json"
_LARGER = "images.HQ"
_FOLDERS = ("images", _LARGER, "matted", "input")  # folders with pictures, of which the first one is used
_MASKS = "image_mask"


@dataclass(frozen=True)
class _Frame:
    picture: Path
    matte: Path | None
    """A separate matte. None if the picture has an opacity."""
    checkpoint: Path | None


@dataclass(frozen=True)
class _Layout:
    kind: str
    name: str
    root: Path
    frames: tuple[_Frame, ...]
    test: tuple[int, ...]
    """Indices of the frames that are held out."""
    split: str
    """The source of the split, in words."""
    unpaired: int
    """Number of pictures without a checkpoint, which are left out."""

    @property
    def is_bare(self) -> bool:
        """Whether there are neither mattes nor opacities, so that mien makes the mattes."""
        return self.kind == "INSTA" and not content.png_has_opacity(self.frames[0].picture)


def _recognises(path: Path) -> str | None:
    if _flash_avatar(path) is not None:
        return "FlashAvatar's folders with checkpoints of metrical-tracker"
    head = content.sniff(path / "transforms.json")
    if b'"exp_path"' in head and b'"timestep_index"' not in head and b'"flame_param_path"' not in head:
        return "a subject of INSTA's data set"
    if any((path / name).is_dir() for name in _FOLDERS) and content.numbered_files(path / "checkpoint", ".frame"):
        return "pictures with checkpoints of metrical-tracker"
    return None


def _flash_avatar(path: Path) -> tuple[Path, Path] | None:
    """The folder with `imgs` and that of the checkpoints, from the root of FlashAvatar or from dataset/NAME."""
    if (path / "imgs").is_dir() and (path / "alpha").is_dir():
        return path, path.parent.parent / "metrical-tracker" / "output" / path.name / "checkpoint"
    subjects = [each for each in sorted(path.glob("dataset/*")) if (each / "imgs").is_dir()]
    if len(subjects) == 1:
        return subjects[0], path / "metrical-tracker" / "output" / subjects[0].name / "checkpoint"
    return None


def _layout(path: Path) -> _Layout:
    flash = _flash_avatar(path)
    if flash is not None:
        folder, checkpoints = flash
        pictures = content.numbered_files(folder / "imgs", ".jpg") or content.numbered_files(folder / "imgs", ".png")
        mattes = content.numbered_files(folder / "alpha", ".jpg") or content.numbered_files(folder / "alpha", ".png")
        saved = {number + 1: place for number, place in content.numbered_files(checkpoints, ".frame").items()}
        return _paired("FlashAvatar", folder, checkpoints.parents[3], pictures, mattes, saved)
    saved = content.numbered_files(path / "checkpoint", ".frame")
    if (path / "transforms.json").exists():
        file = path / "transforms.json"
        pictures = {
            int(place.stem) if place.stem.isascii() and place.stem.isdigit() else number: place
            for number, place in enumerate(content.pictures_of(file, path, content.read_frames(file)))
        }
        return _with_test(path / _TEST, _paired("INSTA", path, path, pictures, {}, saved))
    folder = next((path / name for name in _FOLDERS if (path / name).is_dir()), path / _FOLDERS[0])
    pictures, masks = content.numbered_files(folder, ".png"), content.numbered_files(path / _MASKS, ".png", "mask_")
    return _paired("NeRFBlendShape" if masks else "INSTA", path, path, pictures, masks, saved)


def _with_test(file: Path, layout: _Layout) -> _Layout:
    if not file.exists():
        return layout
    held = set(content.pictures_of(file, layout.root, content.read_frames(file)))
    test = tuple(index for index, frame in enumerate(layout.frames) if frame.picture in held)
    return replace(layout, test=test, split=f"{counted(len(test), 'frame')} of {_TEST} are held out")


def _paired(
    kind: str, folder: Path, root: Path, pictures: dict[int, Path], mattes: dict[int, Path], saved: dict[int, Path]
) -> _Layout:
    if not pictures:
        raise UserError(f"{folder}: has no numbered pictures; copy the files of the dataset again")
    both = sorted(pictures.keys() & saved.keys()) if saved else sorted(pictures)
    if not both:
        raise UserError(f"{folder}: no picture has the number of a checkpoint; copy the files of the dataset again")
    for place in (*pictures.values(), *mattes.values(), *saved.values()):
        content.check_file_inside(root, place)
    frames = tuple(_Frame(pictures[number], mattes.get(number), saved.get(number)) for number in both)
    last = TEST_FRAMES[kind] if len(frames) > TEST_FRAMES[kind] else 0
    test, split = tuple(range(len(frames) - last, len(frames))), f"the last {last} frames are held out ({kind})"
    return _Layout(kind, folder.name, root, frames, test, split, len(pictures) - len(both))


def _survey(path: Path) -> Findings:
    layout = _layout(path)
    tracked = layout.frames[0].checkpoint is not None
    missing = [] if tracked else ["checkpoint (*.frame), so jaw, eyes and identity are not known: use `mien track`"]
    if tracked:
        missing += ["the lids of the tracker, which FLAME has no place for"]
    if layout.is_bare:
        missing.append("mattes: they are made by mien")
    if (path / _LARGER).is_dir() and layout.frames[0].picture.parent.name != _LARGER:
        missing.append(f"the larger pictures of {_LARGER}, which are not used beside {_FOLDERS[0]}")
    if layout.unpaired:
        missing.append(f"checkpoints of {counted(layout.unpaired, 'picture')}, which are left out")
    split = layout.split if layout.test else None
    if not layout.test:
        missing.append(f"a split: {counted(len(layout.frames), 'frame')} are too few for {layout.kind}'s")
    clips = (Clip(layout.name, len(layout.frames)),)
    return Findings(clips, "FLAME 2020" if tracked else None, split, tuple(missing))


def scaled_to_pictures(path: Path, K: np.ndarray, tracked: tuple[int, int] | None, size: tuple[int, int]) -> np.ndarray:
    """Return intrinsics for pictures that are larger than those that were tracked, by a whole factor.

    `tracked` is the width and height of these pictures, or None for `size`.
    """
    width, height = size if tracked is None else tracked
    factor = max(size[0] // max(width, 1), 1)
    if (width * factor, height * factor) != size:
        raise UserError(
            f"{path}: its pictures have {size[0]}x{size[1]} pixels, which is no whole multiple of the {width}x{height} "
            "that were tracked; copy the pictures that belong to the tracking"
        )
    return np.diag([factor, factor, 1.0]) @ K


def _pictures(layout: _Layout) -> tuple[np.ndarray, np.ndarray]:
    from mien.datasets.pictures import read_matte, read_one_camera

    def matte(timestep: int, opacity: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
        frame = layout.frames[timestep]
        found = opacity if frame.matte is None else read_matte(frame.matte, size)
        if found is None:
            raise UserError(f"{frame.picture}: has no opacity and no matte; copy the folder with the mattes as well")
        return found

    places = [frame.picture for frame in layout.frames]
    return read_one_camera(places, layout.name, None if layout.is_bare else matte)


def _read(path: Path, face_model: "FaceModel | None") -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of, needed_flame
    from mien.datasets.metrical_tracker import VERSION, read_tracker_frames
    from mien.datasets.pictures import picture_size
    from mien.datasets.sequences import sequence_of
    from mien.machine.progress import say

    layout = _layout(path)
    checkpoints = _checkpoints(layout)
    if not checkpoints:
        yield from _read_pictures(path)
        return
    model = needed_flame(path, face_model, VERSION)
    face, (K, seen), blinks = read_tracker_frames(checkpoints, model)
    if blinks:
        say(f"{layout.name}: lids are closed in {blinks:.0%} of the frames, which FLAME's parameters do not show")
    size = picture_size(layout.frames[0].picture)
    camera = {"0": camera_of(scaled_to_pictures(path, K, seen, size), FRONT, size)}
    sequence = sequence_of(path, layout.name, _pictures(layout), camera, _FPS, (model, face), VERSION)
    yield replace(sequence, own_split=_own_split(layout))


def _own_split(layout: _Layout) -> "OwnSplit | None":
    from mien.training.settings.splits import OwnSplit, ranges_of

    return OwnSplit(ranges_of(list(layout.test))) if layout.test else None


def _checkpoints(layout: _Layout) -> list[Path]:
    return [frame.checkpoint for frame in layout.frames if frame.checkpoint is not None]


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    """Pictures with the camera of transforms.json, or without that file with the camera of the checkpoints."""
    from mien.datasets.flame_poses import FRONT, camera_of
    from mien.datasets.metrical_tracker import read_tracker_camera
    from mien.datasets.pictures import picture_size
    from mien.datasets.sequences import filmed_sequence

    layout, file = _layout(path), path / "transforms.json"
    size, poses = picture_size(layout.frames[0].picture), {}
    if file.exists():
        K, tracked, poses = _transforms(file)
    elif _checkpoints(layout):
        K, tracked = read_tracker_camera(_checkpoints(layout))
    else:
        raise UserError(
            f"{file}: is missing, and there are no checkpoints, so the camera is not known; {content.REMEDY}"
        )
    camera = {"0": camera_of(scaled_to_pictures(path, K, tracked, size), FRONT, size)}
    sequence = filmed_sequence(path, layout.name, *_pictures(layout), camera, _FPS)
    yield replace(sequence, foreign=poses, own_split=_own_split(layout))


def _transforms(file: Path) -> tuple[np.ndarray, tuple[int, int] | None, dict[str, np.ndarray]]:
    """Intrinsics, width and height that they are for, and poses of transforms.json."""
    from mien.datasets.flame_poses import pinhole

    values = content.read_object(file)
    K = pinhole(*content.scalars(file, values, "fl_x", "fl_y", "cx", "cy"))
    width, height = (int(content.numbers(file, values, name, ())) if name in values else 0 for name in ("w", "h"))
    poses = content.stacked_poses(file, content.frames_of(file, values), "transform_matrix")
    size = (width, height) if width > 0 and height > 0 else None
    return K, size, {"camera_to_head": poses.astype(np.float32)}


INSTA = Dataset(
    "insta",
    "a subject of INSTA, FlashAvatar, GaussianBlendshapes or RGBAvatar: images and checkpoints of metrical-tracker",
    "sequences", _recognises, _read, _survey, _read_pictures,
)  # fmt: skip
