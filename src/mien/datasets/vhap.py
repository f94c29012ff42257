"""VHAP's export and GaussianAvatars' data set: transforms, pictures, masks, and FLAME's parameters for each timestep.

A folder holds one tracked sequence, or a UNION that names the files of several such folders beside it. Each sequence
has a world of its own, so each becomes a sequence of mien.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mien.datasets.content import REMEDY, inner, numbers, read_frames, read_some_arrays, scalars, sniff, stacked_poses
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.disk.reading import is_plain_name
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.camera import Camera
    from mien.datasets.dataset import TrackedSequence
    from mien.face.model import FaceModel
    from mien.training.settings.splits import OwnSplit

_VERSION = "FLAME 2023 (flame2023.pkl) with GaussianAvatars' teeth"
_WHOLE, _TRAIN = "transforms.json", "transforms_train.json"
_PARTS = (_WHOLE, _TRAIN, "transforms_val.json", "transforms_test.json")
_FPS = 25.0  # VHAP stores no frame rate; it resamples videos to this one
_PARAMETERS = ("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr")
_SHARED = ("shape", "static_offset")  # arrays that are the same in all files of a sequence
_SAME_PLACE = 1e-4  # largest difference of a camera's matrix within a sequence


@dataclass(frozen=True)
class _Frame:
    file: Path
    content: dict[str, Any]
    trained: bool


@dataclass(frozen=True)
class _Group:
    name: str
    timesteps: tuple[int, ...]
    cameras: tuple[str, ...]
    frames: dict[tuple[int, str], _Frame]


def _recognises(path: Path) -> str | None:
    if not path.is_dir():
        return None
    known = [name for name in _PARTS if b'"flame_param_path"' in sniff(path / name)]
    return f"an export of VHAP ({', '.join(known)})" if known else None


def _groups(path: Path) -> list[_Group]:
    """The sequences of the folder, each with the frames of all its json files."""
    parts = [_WHOLE] if (path / _WHOLE).exists() else [name for name in _PARTS if (path / name).exists()]
    training = read_frames(path / _TRAIN) if (path / _TRAIN).exists() else []
    trained = {str(frame.get("file_path")) for frame in training}
    found: dict[str, dict[tuple[int, str], _Frame]] = {}
    for part in parts:
        file = path / part
        for number, frame in enumerate(read_frames(file)):
            timestep, camera = _place(file, number, frame)
            name = _folder_of(path, file, frame)
            key = (timestep, camera)
            own = _Frame(file, frame, str(frame.get("file_path")) in trained)
            if found.setdefault(name, {}).setdefault(key, own).content is not frame:
                raise UserError(f"{file}: holds camera {camera} of timestep {timestep} twice; {REMEDY}")
    return [_group(path, name, frames) for name, frames in found.items()]


def _place(file: Path, number: int, frame: dict[str, Any]) -> tuple[int, str]:
    timestep = frame.get("timestep_index")
    camera = frame.get("camera_id", frame.get("camera_index"))
    if type(timestep) is not int or timestep < 0 or not (type(camera) is int or is_plain_name(camera)):
        raise UserError(f"{file}: frame {number} has no 'timestep_index' and 'camera_id'; {REMEDY}")
    return timestep, camera if isinstance(camera, str) else f"{camera:02d}"


def _folder_of(path: Path, file: Path, frame: dict[str, Any]) -> str:
    parts = Path(str(frame.get("flame_param_path"))).parts
    name = parts[1] if len(parts) > 2 and parts[0] == ".." else path.resolve().name
    if not is_plain_name(name):
        raise UserError(f"{file}: {name[:60]!r} cannot be the name of a sequence; {REMEDY}")
    return name


def _group(path: Path, name: str, frames: dict[tuple[int, str], _Frame]) -> _Group:
    timesteps = tuple(sorted({timestep for timestep, _ in frames}))
    cameras = tuple(sorted({camera for _, camera in frames}))
    for timestep in timesteps:
        for camera in cameras:
            if (timestep, camera) not in frames:
                raise UserError(f"{path}: timestep {timestep} of {name} has no picture of camera {camera}; {REMEDY}")
    return _Group(name, timesteps, cameras, frames)


def _own_split(group: _Group) -> "OwnSplit | None":
    """Whole timesteps and cameras that transforms_train.json does not list."""
    from mien.training.settings.splits import OwnSplit, ranges_of

    trained = {key for key, frame in group.frames.items() if frame.trained}
    by_time = {timestep for timestep, _ in trained}
    held = [index for index, timestep in enumerate(group.timesteps) if timestep not in by_time]
    seen = {camera for _, camera in trained} or set(group.cameras)
    return OwnSplit(ranges_of(held), tuple(camera for camera in group.cameras if camera not in seen))


def _survey(path: Path) -> Findings:
    groups = _groups(path)
    split = "what transforms_train.json does not list is held out" if (path / _TRAIN).exists() else None
    missing = [] if split else [f"a split ({_TRAIN})"]
    if any("fg_mask_path" not in frame.content for group in groups for frame in group.frames.values()):
        missing.append("fg_masks: mattes are made by mien")
    clips = tuple(Clip(group.name, len(group.timesteps), len(group.cameras)) for group in groups)
    return Findings(clips, "FLAME 2023 with teeth", split, tuple(missing))


def intrinsics_from_vhap(frame: _Frame, from_below: bool) -> np.ndarray:
    """Intrinsics in pixels. Exports since November 2024 count the principal point's cy from below."""
    from mien.datasets.flame_poses import pinhole

    fx, fy, cx, cy, height = scalars(frame.file, frame.content, "fl_x", "fl_y", "cx", "cy", "h")
    return pinhole(fx, fy, cx, height - cy if from_below else cy)


def _viewmats(group: _Group) -> dict[str, np.ndarray]:
    from mien.datasets.flame_poses import viewmats_from_opengl

    matrices = {}
    for camera in group.cameras:
        frames = [group.frames[timestep, camera] for timestep in group.timesteps]
        poses = [stacked_poses(frame.file, [frame.content], "transform_matrix")[0] for frame in frames]
        if not np.abs(np.stack(poses) - poses[0]).max() < _SAME_PLACE:
            raise UserError(f"{group.name}: the camera {camera} moves, and mien's cameras stand still; {REMEDY}")
        matrices[camera] = viewmats_from_opengl(poses[0])
    return matrices


def _flame_arrays(group: _Group, root: Path) -> dict[str, np.ndarray]:
    """The arrays of all timesteps, as in flame_param.npz of GaussianAvatars."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in (*_PARAMETERS, "dynamic_offset")}
    shared: dict[str, np.ndarray] = {}
    for timestep in group.timesteps:
        frame = group.frames[timestep, group.cameras[0]]
        file = inner(frame.file, root, frame.content.get("flame_param_path"))
        arrays = read_some_arrays(file, (*rows, *_SHARED))
        for name in _PARAMETERS:
            array = arrays.get(name)
            first = rows[name][0] if rows[name] else array
            if array is None or first is None or array.ndim != 2 or len(array) != 1 or array.shape != first.shape:
                raise UserError(f"{file}: {name!r} is not one row of numbers as in the other files; {REMEDY}")
            rows[name].append(array)
        if "dynamic_offset" in arrays and arrays["dynamic_offset"].any():
            raise UserError(
                f"{file}: 'dynamic_offset' is not zero, and mien has no offsets by timestep; set it to zero"
            )
        for name in _SHARED:
            if name not in arrays:
                continue
            kept = shared.setdefault(name, arrays[name])
            if kept.shape != arrays[name].shape or not np.allclose(kept, arrays[name], atol=1e-6):
                raise UserError(f"{file}: {name!r} is not that of the files before it; import each sequence by itself")
    return {**{name: np.concatenate(each) for name, each in rows.items() if each}, **shared}


def _pictures(group: _Group, root: Path) -> tuple[np.ndarray, np.ndarray]:
    from mien.datasets.pictures import collect, fill_mattes, read_matte, read_picture

    first = group.frames[group.timesteps[0], group.cameras[0]]
    announced = tuple(int(numbers(first.file, first.content, name, ())) for name in ("w", "h"))
    probe = inner(first.file, root, first.content.get("file_path"))
    pixels = read_picture(probe, (announced[0], announced[1]))[0]
    size = pixels.shape[1], pixels.shape[0]
    masks = all("fg_mask_path" in frame.content for frame in group.frames.values())

    def read(timestep: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
        frame = group.frames[group.timesteps[timestep], group.cameras[camera]]
        colors, matte = read_picture(inner(frame.file, root, frame.content.get("file_path")), size)
        if masks:
            matte = read_matte(inner(frame.file, root, frame.content.get("fg_mask_path")), size)
        return colors, np.zeros((size[1], size[0]), np.uint8) if matte is None else matte

    images, mattes = collect(len(group.timesteps), len(group.cameras), size, read, f"read {group.name}")
    if not masks and not mattes.any():
        fill_mattes(images, mattes)
    return images, mattes


def _read(path: Path, face_model: "FaceModel | None" = None, *, tracked: bool = True) -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of, face_of_flame, in_front, needed_flame
    from mien.datasets.overlay import check_overlay
    from mien.datasets.sequences import filmed_sequence, tracked_sequence

    model, groups = needed_flame(path, face_model, _VERSION) if tracked else None, _groups(path)
    # The files of a UNION are beside it.
    root = path if all(group.name == path.resolve().name for group in groups) else path.parent
    for group in groups:
        face = None if model is None else face_of_flame(path, model, _flame_arrays(group, root))
        images, mattes = _pictures(group, root)
        viewmats = _viewmats(group)
        if len(viewmats) == 1:
            (camera, viewmat) = next(iter(viewmats.items()))
            face = None if face is None else in_front(face, viewmat)
            viewmats = {camera: FRONT}

        def cameras(
            from_below: bool, group: _Group = group, viewmats: Any = viewmats, images: np.ndarray = images
        ) -> "dict[str, Camera]":
            first = {camera: group.frames[group.timesteps[0], camera] for camera in group.cameras}
            size = images.shape[3], images.shape[2]
            return {
                camera: camera_of(intrinsics_from_vhap(frame, from_below), viewmats[camera], size)
                for camera, frame in first.items()
            }

        if model is None or face is None:
            sequence = filmed_sequence(path, group.name, images, mattes, cameras(False), _FPS)
        else:
            made = partial(tracked_sequence, path, group.name, images, mattes, face_model=model, face=face, fps=_FPS)
            sequence = check_overlay(path, _better(made, cameras, group), _VERSION)
        yield replace(sequence, own_split=_own_split(group) if (path / _TRAIN).exists() else None)


def _better(made: Any, cameras: Any, group: _Group) -> "TrackedSequence":
    """The sequence with cy counted from above or from below, whichever fits the pictures better."""
    from mien.datasets.overlay import measure_overlay
    from mien.machine.progress import say

    above = made(cameras=cameras(False))
    frames = [group.frames[group.timesteps[0], camera] for camera in group.cameras]
    shifts = [abs(float(frame.content["h"]) - 2 * float(frame.content["cy"])) for frame in frames]
    if max(shifts) < 1:
        return above
    below = made(cameras=cameras(True))
    one, other = (measure_overlay(sequence) for sequence in (above, below))
    if one.distance is not None and other.distance is not None:
        is_below = other.distance < one.distance
    else:
        is_below = other.agreement > one.agreement
    say(f"{group.name}: cy is counted from {'below' if is_below else 'above'}, which fits the pictures better")
    return below if is_below else above


VHAP = Dataset(
    "vhap", "an export of VHAP, or a UNION folder of GaussianAvatars, with flame_param", "sequences", _recognises,
    _read, _survey, partial(_read, tracked=False),
)  # fmt: skip
