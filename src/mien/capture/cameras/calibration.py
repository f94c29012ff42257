"""Read the calibration of several cameras, and check that it fits their pictures."""

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.camera import Camera
from mien.disk.reading import is_plain_name, listed
from mien.errors import UserError
from mien.media.color_correction import ColorCorrection, correction_of_entry
from mien.media.lens import Lens, lens_of_entry
from mien.render.camera_paths import camera_of_entry, read_camera_entries

_MAX_ASPECT_ERROR = 0.01  # largest relative difference between the aspect ratios of a camera and of its pictures


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A camera of a calibration file."""

    camera_id: str
    """Id, which is also the name of the camera's video without its ending, or of its folder of pictures."""
    camera: Camera
    """The camera for pictures of `camera.width` x `camera.height`, in a world frame that all cameras share."""
    offset: int = 0
    """Frames to leave out at the beginning of its video, so that frame n of all cameras is the same moment."""
    lens: Lens | None = None
    """Its lens, for pictures of the camera's size. None if it does not distort."""
    colors: ColorCorrection | None = None
    """Correction of its pictures' colours, or None."""

    def for_pictures(self, width: int, height: int) -> Camera:
        """Return the camera for pictures of another size but the same shape."""
        camera = self.camera
        if (camera.width, camera.height) == (width, height):
            return camera
        if abs(math.log(camera.width * height / (camera.height * width))) > _MAX_ASPECT_ERROR:
            raise UserError(
                f"camera {self.camera_id}: its calibration is for pictures of {camera.width}x{camera.height}, its "
                f"video has {width}x{height}; give the calibration of these pictures, or turn them with --capture.turn"
            )
        return camera.resized(width, height)


def read_calibration(path: Path) -> list[CalibratedCamera]:
    """Read the cameras of a rig from json.

    {"format": "mien.cameras", "version": 1,
     "cameras": [{"id": "00", "K": 3x3, "viewmat": 4x4, "width": .., "height": .., "offset": 0}, ...]}

    It is the format of a camera path with an `id` for every camera and, if cameras did not start together, an
    `offset` in frames. Intrinsics are in pixels of the uncut video. World-to-camera matrices have OpenCV axes and
    metres (docs/conventions.md). `distortion` is a list of OpenCV's coefficients, k1 k2 p1 p2 k3 ..., and
    `color_correction` has a row of coefficients for each channel (`mien.media.color_correction`).
    """
    entries = read_camera_entries(path, "give one entry for every camera")
    found = [_calibrated_camera(entry, f"{path}: camera {index}") for index, entry in enumerate(entries)]
    for camera_id, count in Counter(camera.camera_id for camera in found).items():
        if count > 1:
            raise UserError(f"{path}: two cameras have the id {camera_id!r}; give every camera its own")
    return found


def match_sources(sources: list[Path], cameras: list[CalibratedCamera], path: Path) -> list[Path]:
    """Return the video or folder of pictures of each camera, named by its id. `sources` may also be their folder."""
    if len(sources) == 1 and sources[0].is_dir():
        folder = sources[0]
        sources = [entry for entry in listed(folder) if (entry.is_dir() or entry.is_file()) and entry != path]
        sources = [entry for entry in sources if entry.is_dir() or entry.suffix.lower() != ".json"]
    ids = {camera.camera_id for camera in cameras}
    by_id: dict[str, Path] = {}
    for source in sources:
        camera_id = source.name if source.is_dir() else source.stem
        if camera_id not in ids:
            raise UserError(
                f"{source}: {path} has no camera {camera_id!r}, it has {_listed(ids)}; name each video like its "
                "camera's id, or correct the calibration"
            )
        if camera_id in by_id:
            raise UserError(f"{source} and {by_id[camera_id]}: both are of the camera {camera_id!r}; leave one out")
        by_id[camera_id] = source
    missing = ids - by_id.keys()
    if missing:
        raise UserError(
            f"{path}: there is no video of the camera {_listed(missing)}; add it, or take the camera out of the file"
        )
    return [by_id[camera.camera_id] for camera in cameras]


def is_file_name(name: object) -> bool:
    """Whether a camera's name can be the name of a folder on any system."""
    return is_plain_name(name) and not set(str(name)) & set(':*?"<>|')


def _listed(ids: set[str]) -> str:
    ordered = sorted(ids)
    return ", ".join(ordered[:6]) + (f", ... ({len(ordered)} in all)" if len(ordered) > 6 else "")


def _calibrated_camera(entry: Any, where: str) -> CalibratedCamera:
    if not isinstance(entry, dict) or "id" not in entry:
        raise UserError(f"{where}: has no `id`; give each camera the name of its video, without the ending")
    camera_id, offset = entry["id"], entry.get("offset", 0)
    if not is_file_name(camera_id):
        raise UserError(
            f"{where}: {camera_id!r} cannot be an id; give a text that can be the name of a folder, such as '08'"
        )
    if not isinstance(offset, int) or isinstance(offset, bool) or not 0 <= offset <= 1_000_000:
        raise UserError(f"{where} ({camera_id}): offset {offset!r} is not a number of frames; give 0 or more")
    where = f"{where} ({camera_id})"
    camera = camera_of_entry(entry, where)
    lens, colors = lens_of_entry(entry, camera, where), correction_of_entry(entry, where)
    return CalibratedCamera(camera_id, camera, offset, lens, colors)
