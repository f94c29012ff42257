"""Sequences of datasets that are videos go through `mien capture`, with the cameras and plates of the dataset."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mien.camera import Camera
from mien.capture.from_cameras import capture_cameras
from mien.capture.from_video import capture_video
from mien.capture.settings import CaptureSettings
from mien.datasets.dataset import Dataset, Footage
from mien.errors import UserError
from mien.inside import inside, remove_tree
from mien.media.color_correction import NAME as COLOR_CORRECTION
from mien.storage import write_atomically
from mien.training.splits.own import write_own_split


def write_footage(folder: Path, footage: Footage, dataset: Dataset, source: Path) -> None:
    """Capture the videos of a sequence into its folder, and write what else the dataset has beside it.

    Args:
        folder: The sequence's folder, which is missing.
        footage: The videos and what is known of them.
        dataset: The dataset that it comes from.
        source: The place that it was read from.
    """
    settings = CaptureSettings(stride=footage.stride)
    try:
        if footage.cameras is None:
            capture_video(footage.videos[0], folder / "capture", settings, footage.name)
        else:
            _capture_rig(folder / "capture", footage, footage.cameras, source)
        imported = {"dataset": dataset.name, "from": str(source.absolute())}
        write_own_split(folder, footage.own_split, {"imported": imported})
        for name, content in footage.files.items():
            write_atomically(inside(folder, name), lambda place, content=content: place.write_bytes(content))
    except BaseException:
        remove_tree(folder)
        raise


def _capture_rig(out: Path, footage: Footage, cameras: Mapping[str, Camera], source: Path) -> None:
    """Capture calibrated videos. They get the names of their cameras by links, which the capture expects.

    Complaints about a link or the calibration name what the user knows instead.
    """
    corrections = None if footage.color_corrections is None else footage.color_corrections()
    with tempfile.TemporaryDirectory(prefix="mien-import-") as name:
        place = Path(name)
        videos, known = [], {}
        for camera_id, video in zip(cameras, footage.videos, strict=True):
            videos.append(place / f"{camera_id}{video.suffix}")
            videos[-1].symlink_to(video.resolve())
            known[str(videos[-1])] = str(video)
        plates = None
        if footage.clean_plates is not None:
            plates = place / "plates"
            plates.mkdir()
            for camera_id, plate in footage.clean_plates.items():
                link = plates / f"{camera_id}{plate.suffix}"
                link.symlink_to(plate.resolve())
                known[f"--capture.clean-plate {link}"] = known[str(link)] = str(plate)
        calibration = place / "cameras.json"
        entries: list[dict[str, Any]] = [
            {"id": camera_id, "K": camera.K.double().tolist(), "viewmat": camera.viewmat.double().tolist(),
             "width": camera.width, "height": camera.height}
            for camera_id, camera in cameras.items()
        ]  # fmt: skip
        for entry, (camera_id, matrix) in zip(entries, corrections.items(), strict=True) if corrections else ():
            assert entry["id"] == camera_id
            entry[COLOR_CORRECTION] = matrix.tolist()
        calibration.write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": entries}))
        settings = CaptureSettings(stride=footage.stride, clean_plate=plates)
        try:
            capture_cameras(videos, calibration, out, footage.name, settings)
        except UserError as error:
            if str(place) not in str(error):
                raise
            told = str(error)
            for link, file in {**known, str(calibration): f"{source} (its cameras)"}.items():
                told = told.replace(link, file)
            raise UserError(told) from None
