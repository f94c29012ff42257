"""Cross-reenactment: another sequence drives the avatar, relative to the neutrals of both. There is no true picture."""

from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from mien.avatar.avatar import Avatar
from mien.avatar.files import load_avatar
from mien.avatar.resting import neutral_of
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.capture.person.faces import MeshReader
from mien.capture.store import read_capture, read_capture_hash
from mien.driving.rest import rest_before
from mien.driving.transfer import drive, place_torso
from mien.errors import UserError
from mien.evaluation.redetection import MEASURED_BY, MeasuredMotion, measure_motion, transfer_figures
from mien.evaluation.videos import labeled_row, match_sizes
from mien.face.checks import check_face_params
from mien.face.params import FaceParams, most_frontal_camera
from mien.machine.progress import track_progress
from mien.media.pictures import to_uint8
from mien.media.video import write_video
from mien.render import rasterize
from mien.rotation import matrix_from_axis_angle
from mien.tracking.files import check_tracking_of, read_tracking
from mien.tracking.tracking import Tracking
from mien.training.footage.frames import evenly_spread

_MAX_FRAMES = 100
_MEANS = (
    "expression_error", "expression_error_still", "head_rotation_error_degrees", "head_rotation_error_still_degrees",
    "mouth_correlation", "eyes_correlation", "faces_found",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Driven:
    """An avatar that a driver drives."""

    avatar: Avatar
    camera: Camera
    faces: FaceParams
    """Face parameters of the avatar, one per timestep of the driver."""
    driver: Capture
    tracking: Tracking
    driver_camera: int
    """Index of the driver's camera that sees the face most squarely."""
    by_rest: tuple[int, ...]
    """Timesteps with a tracked face, sorted by their distance from the driver's neutral, nearest first."""

    @torch.no_grad()
    def picture(self, timestep: int) -> UInt8[np.ndarray, "h w 3"]:
        """The avatar at a timestep, over white."""
        gaussians = self.avatar.pose(self.faces[timestep]).gaussians.timestep(0)
        return to_uint8(rasterize(gaussians, self.camera, torch.ones(3)).image)

    def driver_picture(self, timestep: int) -> UInt8[np.ndarray, "h w 3"]:
        """The driver at a timestep."""
        return np.ascontiguousarray(self.driver.images[timestep, self.driver_camera])


def load_driven(run_dir: Path, sequence_dir: Path, driver_dir: Path) -> Driven:
    """A run's avatar, driven by another sequence, and seen by the most frontal camera of `sequence_dir`."""
    avatar, tracking = load_avatar(run_dir), read_tracking(driver_dir / "tracking")
    if tracking.face_model_hash != avatar.face_model.content_hash:
        raise UserError(
            f"{driver_dir}: was tracked with the face model {tracking.face_model}, but the avatar has another "
            f"({avatar.face_model.name}); track the driver with the avatar's face model"
        )
    check_face_params(avatar.face_model, tracking.face, str(driver_dir), "track it again")
    capture = read_capture(driver_dir / "capture")
    check_tracking_of(capture, tracking, driver_dir / "tracking")
    valid = torch.nonzero(tracking.valid)[:, 0].tolist()
    if not valid:
        raise UserError(f"{driver_dir}: has no tracked frame; choose another driver")
    cameras, model = read_tracking(sequence_dir / "tracking").cameras, avatar.face_model
    calm = neutral_of(tracking.face[tracking.valid])
    at_rest, person = rest_before(calm, model, tracking.cameras).face, rest_before(avatar.subject, model, cameras).face
    faces = drive(tracking.face, at_rest, person, model.expression_bounds, who=str(driver_dir))
    faces = place_torso(model, faces, avatar.subject)
    return Driven(
        avatar=avatar,
        camera=cameras[most_frontal_camera(cameras, avatar.subject)],
        faces=faces,
        driver=capture,
        tracking=tracking,
        driver_camera=most_frontal_camera(tracking.cameras, calm),
        by_rest=tuple(sorted(valid, key=_activity(tracking.face, at_rest).__getitem__)),
    )


def _activity(face: FaceParams, at_rest: FaceParams) -> list[float]:
    """The distance of each timestep from rest: expression coefficients plus the head's rotation in radians."""
    turn = matrix_from_axis_angle(at_rest.head_rotation).transpose(-1, -2) @ matrix_from_axis_angle(face.head_rotation)
    angle = ((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).arccos()
    return ((face.expression - at_rest.expression).norm(dim=-1) + angle).tolist()


def cross_reenactment(
    run_dir: Path, sequence_dir: Path, driver_dirs: Items[Path], video_frames: int
) -> tuple[dict[str, Any], list[Path]]:
    """The protocol's entry of metrics.json, and side-by-side videos (driver, avatar) in the run's folder.

    Figures are means over drivers; `mien.evaluation.redetection` describes them. They say how much of the motion
    arrives, not how good pictures look. The avatar's own sequence as a driver shows the best that can be expected.

    `sequence_dir` is a sequence that the run was trained on: its camera sees the avatar. `video_frames` is the largest
    number of frames per video, or 0 for no videos.
    """
    entries, videos = [], []
    for folder in driver_dirs:
        name = _driver_name(folder)
        driven = load_driven(run_dir, sequence_dir, folder)
        entries.append({"driver": name, "pictures": read_capture_hash(folder / "capture"), **measure(driven, name)})
        if video_frames:
            videos.append(_write_video(run_dir / "videos" / f"cross_reenactment_{name}.mp4", driven, video_frames))
    content: dict[str, Any] = {}
    for key in _MEANS:
        known = [entry[key] for entry in entries if entry[key] is not None]
        content[key] = fmean(known) if known else None
    frames = sum(entry["frames"] for entry in entries)
    return {**content, "frames": frames, "measured_by": MEASURED_BY, "drivers": entries}, videos


def measure(driven: Driven, name: str) -> dict[str, Any]:
    """Figures of evenly spread frames of one driver. They are None if no face is found in the avatar's pictures."""
    frames = evenly_spread(sorted(driven.by_rest), _MAX_FRAMES)
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    found_driver = found_avatar = 0
    with MeshReader(1, is_video=False) as mesh:
        for timestep in track_progress(frames, f"driven by {name}", len(frames)):
            theirs = mesh.read(driven.driver_picture(timestep))
            if not len(theirs):
                continue
            found_driver += 1
            ours = mesh.read(driven.picture(timestep))
            if len(ours):
                found_avatar += 1
                seen[timestep] = theirs[0], ours[0]
    if not found_driver:
        raise UserError(f"{name}: no face is found in the driver's pictures; choose another driver")
    figures: dict[str, float | None] = dict.fromkeys(_MEANS)
    if seen:
        rest = seen[next(timestep for timestep in driven.by_rest if timestep in seen)]
        pairs: list[tuple[MeasuredMotion, MeasuredMotion]] = [
            (measure_motion(theirs, rest[0]), measure_motion(ours, rest[1])) for theirs, ours in seen.values()
        ]
        figures |= transfer_figures(pairs)
    return {**figures, "faces_found": found_avatar / found_driver, "frames": found_driver}


def _write_video(path: Path, driven: Driven, max_count: int) -> Path:
    timesteps = range(min(max_count, driven.driver.timesteps))
    pictures = (
        labeled_row({f"driver: {t}": driven.driver_picture(t), "avatar": driven.picture(t)})
        for t in track_progress(timesteps, f"video {path.stem}", len(timesteps))
    )
    write_video(path, match_sizes(pictures), driven.driver.fps, crf=24)
    return path


def _driver_name(folder: Path) -> str:
    """WORKSPACE_SEQUENCE, or only one name if both are the same, or the folder's name if it is in no workspace."""
    folder = folder.resolve()
    in_workspace = folder.parent.name == "sequences"
    names = [folder.parent.parent.name, folder.name] if in_workspace else [folder.name]
    return "_".join(dict.fromkeys(names))
