"""The NeRSemble benchmark (version 2): novel views of many cameras, and avatars from one camera on FLAME 2023.

The monocular task has tracking; its test sequences have no pictures and are not imported. FLAME's root is at rest
there: the whole model is turned, scaled and shifted about the origin of the model.
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mien.datasets.content import REMEDY, check_file_inside, is_file_inside, read_arrays
from mien.datasets.dataset import Clip, Dataset, Findings, ReadSequence
from mien.datasets.nersemble import CALIBRATION, FRONTAL, frames_in, has_mattes, read_cameras
from mien.errors import UserError
from mien.training.settings.splits import HIDDEN_CAMERAS, OwnSplit

if TYPE_CHECKING:
    from mien.camera import Camera
    from mien.face.model import FaceModel
    from mien.training.settings.splits import OwnSplit

VERSION = "FLAME 2023 (flame2023.pkl)"
TRACKING = "flame2023_tracking_v2.npz"
TEST_ENDING = "-test"
"""End of the names of sequences that `mien export-dataset` writes of held-out frames. The benchmark itself has none."""
FPS_MONO, FPS_VIEWS = 24.3, 73.0
_MAX_ANGLE = 1e-4  # largest difference of the two forms of a rotation


def _sequences(path: Path) -> list[Path]:
    """The sequences' folders that have pictures and mattes."""
    folders = sorted(folder for folder in path.glob("sequences/*") if has_mattes(folder))
    return [folder for folder in folders if any((folder / "images").glob("cam_*.mp4"))]


def _recognises(path: Path) -> str | None:
    if not (path / CALIBRATION).is_file() or not _sequences(path):
        return None
    mono = any((folder / "tracking" / TRACKING).is_file() for folder in _sequences(path))
    return f"a person of the NeRSemble benchmark ({'one camera, with tracking' if mono else 'novel views'})"


def _videos(folder: Path, root: Path) -> dict[str, Path]:
    found = {}
    for video in sorted((folder / "images").glob("cam_*.mp4")):
        if is_file_inside(root, video):
            found[video.stem.removeprefix("cam_")] = video
    return found


def _survey(path: Path) -> Findings:
    folders = _sequences(path)
    mono = [folder for folder in folders if (folder / "tracking" / TRACKING).is_file()]
    videos = {folder: _videos(folder, path) for folder in folders}
    clips = tuple(Clip(folder.name, frames_in(own.values()), len(own)) for folder, own in videos.items())
    hidden = [folder.parent.parent.name for folder in sorted(path.glob(f"sequences/*/tracking/{TRACKING}"))
              if folder.parent.parent not in folders]  # fmt: skip
    missing = [] if mono else ["a tracking: use `mien track`"]
    if hidden:
        missing.append(f"pictures of {', '.join(hidden)}, which are hidden: they are not imported")
    there = {serial for own in videos.values() for serial in own}
    hidden_cameras = [serial for serial in HIDDEN_CAMERAS if serial not in there]
    if not mono and hidden_cameras:
        missing.append(f"the cameras {', '.join(hidden_cameras)}, which are hidden")
    return Findings(clips, "FLAME 2023" if mono else None, None, tuple(missing))


def flame_from_benchmark(file: Path) -> "tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, float]":
    """Read a tracking: FLAME's arrays with the root at rest, then rotations, translations and scale of the model.

    Rotations are those of `rotation_matrices`. The Euler angles of `rotation` must say the same.
    """
    axes = {
        "shape": "1s", "expression": "te", "rotation": "t3", "rotation_matrices": "t33", "translation": "t3",
        "scale": "11", "jaw": "t3", "neck": "t3", "eyes": "t6",
    }  # fmt: skip
    arrays = {name: array.astype(np.float64) for name, array in read_arrays(file, axes, {}).items()}
    scale = float(arrays["scale"][0, 0])
    if not 0.01 < scale < 100:
        raise UserError(f"{file}: the scale {scale:g} is not that of a head; {REMEDY}")
    turns = arrays["rotation_matrices"]
    if not np.abs(turns - _euler_xyz(arrays["rotation"])).max() < _MAX_ANGLE * 10:
        raise UserError(f"{file}: 'rotation' and 'rotation_matrices' differ; {REMEDY}")
    flame = {"shape": arrays["shape"][0], "expr": arrays["expression"], "jaw_pose": arrays["jaw"],
             "neck_pose": arrays["neck"], "eyes_pose": arrays["eyes"]}  # fmt: skip
    return flame, turns, arrays["translation"], scale


def _euler_xyz(angles: np.ndarray) -> np.ndarray:
    """Rotations Rx Ry Rz [t, 3, 3] of angles about x, y and z in radians."""
    import torch

    from mien.rotation import matrix_from_axis_angle

    x, y, z = (matrix_from_axis_angle(torch.from_numpy(angles) * torch.eye(3, dtype=torch.float64)[axis])
               for axis in range(3))  # fmt: skip
    return (x @ y @ z).numpy()


def _pictures(folder: Path, root: Path) -> "tuple[list[str], np.ndarray, np.ndarray]":
    """Serial numbers, pictures and mattes of a sequence's videos."""
    from mien.datasets.pictures import collect
    from mien.media.video import count_frames, read_video_frames

    videos = _videos(folder, root)
    if not videos:  # a link to itself is no file, and yet a name
        raise UserError(f"{folder / 'images'}: none of its videos (cam_SERIAL.mp4) can be read; {REMEDY}")
    serials = list(dict.fromkeys(serial for serial in (FRONTAL, *videos) if serial in videos))
    opened = {}
    for serial in serials:
        matte = folder / "alpha_maps" / videos[serial].name
        if not is_file_inside(root, matte):
            raise UserError(f"{matte}: is missing, the mattes of {videos[serial].name}; {REMEDY}")
        opened[serial] = (read_video_frames(videos[serial]), read_video_frames(matte))
    counts = {serial: count_frames(videos[serial]) for serial in serials}
    if len(set(counts.values())) != 1:
        raise UserError(f"{folder}: its videos have {min(counts.values())} to {max(counts.values())} frames; {REMEDY}")
    first = next(opened[serials[0]][0])[1]
    size = first.shape[1], first.shape[0]
    opened[serials[0]] = (itertools.chain([(0.0, first)], opened[serials[0]][0]), opened[serials[0]][1])

    def read(timestep: int, camera: int) -> tuple[np.ndarray, np.ndarray]:
        colors, alpha = (next(source, None) for source in opened[serials[camera]])
        if colors is None or alpha is None:
            raise UserError(f"{videos[serials[camera]]}: picture or matte {timestep} is missing; {REMEDY}")
        for picture in (colors[1], alpha[1]):
            if (picture.shape[1], picture.shape[0]) != size:
                raise UserError(f"{videos[serials[camera]]}: is not {size[0]}x{size[1]} as the other videos; {REMEDY}")
        return colors[1], np.ascontiguousarray(alpha[1][..., 0])

    return serials, *collect(counts[serials[0]], len(serials), size, read, f"read {folder.name}")


def _own_split(folder: Path, timesteps: int) -> "OwnSplit | None":
    """The split of a folder that `mien export-dataset` wrote, whose held-out frames are a sequence of their own."""
    if folder.name.endswith(TEST_ENDING):
        return OwnSplit(((0, timesteps),))
    return OwnSplit() if folder.with_name(f"{folder.name}{TEST_ENDING}").is_dir() else None


def _read(path: Path, face_model: "FaceModel | None") -> Iterator[ReadSequence]:
    from mien.datasets.flame_poses import FRONT, camera_of, carried, face_of_flame, in_front, needed_flame
    from mien.datasets.sequences import sequence_of

    folders = [folder for folder in _sequences(path) if (folder / "tracking" / TRACKING).is_file()]
    if not folders:
        yield from _read_pictures(path)
        return
    model = needed_flame(path, face_model, VERSION)
    for folder in folders:
        file = folder / "tracking" / TRACKING
        check_file_inside(path, file)
        flame, turns, shifts, scale = flame_from_benchmark(file)
        serials, images, mattes = _pictures(folder, path)
        if len(images) != len(turns):
            raise UserError(f"{file}: has {len(turns)} frames, but the video has {len(images)}; {REMEDY}")
        size = images.shape[3], images.shape[2]
        known = _known_cameras(path, serials[:1], size)[serials[0]]
        viewmat = known.viewmat.double().numpy().copy()
        viewmat[:3, 3] /= scale
        face = in_front(carried(face_of_flame(file, model, flame), turns, shifts / scale), viewmat)
        camera = {serials[0]: camera_of(known.K.double().numpy(), FRONT, size)}
        pictures = images[:, :1], mattes[:, :1]
        sequence = sequence_of(file, folder.name, pictures, camera, FPS_MONO, (model, face), VERSION)
        yield replace(sequence, own_split=_own_split(folder, len(face)))


def _known_cameras(path: Path, serials: list[str], size: tuple[int, int]) -> "dict[str, Camera]":
    known = read_cameras(path / CALIBRATION, size)
    unknown = [serial for serial in serials if serial not in known]
    if unknown:
        raise UserError(f"{path}: its calibration has no camera {unknown[0]}; {REMEDY}")
    return {serial: known[serial] for serial in serials}


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    from mien.datasets.sequences import filmed_sequence

    for folder in _sequences(path):
        serials, images, mattes = _pictures(folder, path)
        cameras = _known_cameras(path, serials, (images.shape[3], images.shape[2]))
        fps = FPS_VIEWS if len(serials) > 1 else FPS_MONO
        sequence = filmed_sequence(folder, folder.name, images, mattes, cameras, fps)
        yield replace(sequence, own_split=_own_split(folder, len(images)))


NERSEMBLE_BENCHMARK = Dataset(
    "nersemble-benchmark", "a person's folder of the NeRSemble benchmark: calibration, images and alpha_maps",
    "sequences", _recognises, _read, _survey, _read_pictures,
)  # fmt: skip
