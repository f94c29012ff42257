"""NeRSemble's raw recordings: videos of 16 calibrated cameras for each sequence of a person.

They have no mattes and no tracking, so `mien capture` processes the videos. The picture of the empty scene, in the
sequence BACKGROUND, serves as its clean plate. Every third frame of 73 a second is taken, as in other work (24.3).

The colours of videos and clean plates are corrected by the polynomials of `calibration/color_calibration.json`, in
which the authors measured each camera: {serial: 3 x n matrix}.
"""

import os
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mien.datasets.content import REMEDY, check_file_inside, is_file_inside, numbers, read_object, rotation_part
from mien.datasets.dataset import Clip, Dataset, Findings, Footage, ReadSequence
from mien.disk.reading import is_plain_name
from mien.errors import UserError

if TYPE_CHECKING:
    from mien.camera import Camera

SIZE = (2200, 3208)
"""Width and height that the intrinsics are for."""
SERIALS = (
    "222200042", "222200044", "222200046", "222200040", "222200036", "222200048", "220700191", "222200041", "222200037",
    "222200038", "222200047", "222200043", "222200049", "222200039", "222200045", "221501007",
)  # fmt: skip
"""The cameras in the order of the indices 0 to 15 that papers use. Index 8 is the frontal camera."""
FRONTAL = SERIALS[8]
CALIBRATION, _COLORS = "calibration/camera_params.json", "calibration/color_calibration.json"
"""Names of files in the folder of a person."""
_STRIDE = 3
_EMPTY = "BACKGROUND"


def _recognises(path: Path) -> str | None:
    if not (path / CALIBRATION).is_file() or not (path / "sequences").is_dir():
        return None
    names = _names(path)
    if not names or any(has_mattes(path / "sequences" / name) for name in names):
        return None
    return f"a person of NeRSemble ({len(names)} sequence{'s' * (len(names) != 1)})"


def has_mattes(sequence: Path) -> bool:
    """Whether a sequence's folder has mattes, as the benchmark's have. Links to nothing count, to be refused later."""
    return os.path.lexists(sequence / "alpha_maps")


def _names(path: Path) -> list[str]:
    folders = sorted(path.glob("sequences/*/images"))
    return [folder.parent.name for folder in folders if any(folder.glob("cam_*.mp4"))]


def read_cameras(file: Path, size: tuple[int, int]) -> "dict[str, Camera]":
    """Return each camera by its serial number, for pictures of this width and height.

    World-to-camera matrices are OpenCV's, in metres. Intrinsics are one matrix for all cameras, or one for each. Files
    of `mien export-dataset` name the `image_size` that they are for; for others it is found by the principal point.
    """
    from mien.datasets.flame_poses import camera_of

    content = read_object(file)
    poses = content.get("world_2_cam")
    if not isinstance(poses, dict) or not poses or not all(is_plain_name(serial) for serial in poses):
        raise UserError(f"{file}: has no 'world_2_cam' with a matrix for each camera; {REMEDY}")
    shared, cameras = content.get("intrinsics"), {}
    own = numbers(file, content, "image_size", (2,)) if "image_size" in content else None
    for serial in poses:
        viewmat = rotation_part(file, serial, numbers(file, poses, serial, (4, 4)))
        given = numbers(file, shared, serial, (3, 3)) if isinstance(shared, dict) else numbers(
            file, content, "intrinsics", (3, 3)
        )  # fmt: skip
        K = scaled_intrinsics(given, size) if own is None else np.diag([*(np.array(size) / own), 1.0]) @ given
        cameras[serial] = camera_of(K, np.asarray(viewmat), size)
    return cameras


def scaled_intrinsics(K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics for pictures of another size than `SIZE`. A principal point beyond the picture shows which they are.

    Raw calibrations are for full pictures. Those of the benchmark are for its own pictures already.
    """
    width, height = size
    if K[0, 2] < width and K[1, 2] < height and K[0, 2] > 0.25 * width:
        return K
    return np.diag([width / SIZE[0], height / SIZE[1], 1.0]) @ K


def frames_in(videos: Iterable[Path]) -> int | None:
    """Return the number of frames of the first video, or None if it is damaged or there is none."""
    from mien.media.video import count_frames

    for video in videos:
        try:
            return count_frames(video)
        except UserError:  # whoever reads it says what is wrong with it
            return None
    return None


def _survey(path: Path) -> Findings:
    clips = []
    for name in _names(path):
        videos = sorted((path / "sequences" / name / "images").glob("cam_*.mp4"))
        frames = frames_in(video for video in videos if is_file_inside(path, video))
        clips.append(Clip(name, None if frames is None else -(-frames // _STRIDE), len(videos)))
    missing = ["two of three frames", "mattes and tracking: `mien capture` and `mien track` make them"]
    colors = path / _COLORS
    if not colors.is_file():
        missing.append(f"colour correction ({_COLORS}): cameras differ in their colours without it")
    if not any((path / "sequences" / _EMPTY).glob("image_*.jpg")):
        missing.append(f"pictures of the empty scene (sequences/{_EMPTY}): mattes are less exact without them")
    found = f"by {_COLORS}; --no-color-correction leaves it out" if colors.is_file() else None
    return Findings(tuple(clips), None, None, tuple(missing), found)


def _read_pictures(path: Path) -> Iterator[ReadSequence]:
    cameras = read_cameras(path / CALIBRATION, SIZE)
    colors = path / _COLORS
    for name in _names(path):
        videos = {}
        for video in sorted((path / "sequences" / name / "images").glob("cam_*.mp4")):
            check_file_inside(path, video)
            videos[video.stem.removeprefix("cam_")] = video
        unknown = [serial for serial in videos if serial not in cameras]
        if unknown:
            raise UserError(f"{path / CALIBRATION}: has no camera {unknown[0]}, of which {name} has a video; {REMEDY}")
        yield Footage(
            name, tuple(videos.values()), {serial: cameras[serial] for serial in videos},
            clean_plates=_plates(path, videos),
            color_corrections=partial(_corrections, path, tuple(videos)) if is_file_inside(path, colors) else None,
            stride=_STRIDE,
        )  # fmt: skip


def _corrections(path: Path, serials: tuple[str, ...]) -> dict[str, np.ndarray]:
    from mien.media.color_correction import color_correction

    file = path / _COLORS
    content, found = read_object(file), {}
    for serial in serials:
        if serial not in content:
            raise UserError(f"{file}: has no correction of the camera {serial}; {REMEDY}, or add --no-color-correction")
        found[serial] = numbers(file, content, serial, (3, None))
        color_correction(found[serial], f"{file}: {serial!r}")
    return found


def _plates(path: Path, videos: dict[str, Path]) -> "dict[str, Path] | None":
    plates = {serial: path / "sequences" / _EMPTY / f"image_{serial}.jpg" for serial in videos}
    return plates if all(is_file_inside(path, plate) for plate in plates.values()) else None


NERSEMBLE = Dataset(
    "nersemble", "a person's folder of NeRSemble's raw recordings: calibration and sequences", "sequences", _recognises,
    lambda path, face_model: _read_pictures(path), _survey, _read_pictures,
)  # fmt: skip
