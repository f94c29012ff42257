"""The stages as the command line runs them: each reads its folders, skips what is current, writes its own folder."""

import hashlib
import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.avatar import MethodConfig, load_avatar, neutral_of
from mien.capture import Capture, CaptureSettings, capture_video, read_capture, read_capture_hash
from mien.capture.video import write_video
from mien.errors import UserError
from mien.evaluation.driving import drive
from mien.evaluation.evaluate import evaluate
from mien.evaluation.pictures import side_by_side, to_uint8
from mien.face import FaceModel, load_face_model
from mien.progress import say, track_progress
from mien.render import rasterize
from mien.tracking import (
    Tracking,
    TrackingSettings,
    make_scoring,
    read_tracking,
    scoring_exists,
    track,
    write_scoring,
    write_tracking,
)
from mien.training import TrainSettings, read_run_config, read_sequence, read_training_summary, train
from mien.training.run import run_camera
from mien.workspace import Workspace

_TRACKING_RECIPE = 2
"""Raised whenever the same capture would be tracked otherwise, so that old trackings are not taken for current."""


def capture_stage(workspace: Workspace, video: Path, name: str | None, settings: CaptureSettings) -> str:
    """Capture a video into the workspace; returns the sequence's name."""
    name = sequence_name(video, name)
    folder = workspace.sequence_dir(name)
    before = read_capture_hash(folder / "capture") if (folder / "capture" / "capture.json").is_file() else None
    capture = capture_video(video, folder / "capture", settings, name)
    if before not in (None, read_capture_hash(folder / "capture")) and scoring_exists(folder / "scoring"):
        say(f"{name}: the pictures changed, so the scoring mask is made anew")
        shutil.rmtree(folder / "scoring")
    found = int(capture.valid.any(axis=1).sum())
    say(f"{name}: {capture.timesteps} frames of {capture.width}x{capture.height}, a face in {found} of them")
    return name


def sequence_name(video: Path, name: str | None) -> str:
    """`name`, or the video's name without its ending, if it can be a folder's.

    Raises:
        UserError: it is empty or holds a path separator.
    """
    name = video.stem if name is None else name
    if not name or name in (".", "..") or "/" in name:
        raise UserError(f"{name!r} cannot be the name of a folder; give another with --name or --run")
    return name


def tracking_stage(
    workspace: Workspace, name: str, face_model_name: str, settings: TrackingSettings, again: bool = False
) -> Tracking:
    """Track a sequence, write the overlay and, once for ever, the scoring mask; a current tracking is read back."""
    folder = workspace.sequence_dir(name)
    face_model = load_face_model(face_model_name)
    fingerprint = _tracking_fingerprint(read_capture_hash(folder / "capture"), face_model, settings)
    tracking = None if again else _current_tracking(folder / "tracking", fingerprint)
    if tracking is None:
        capture = read_capture(folder / "capture")
        tracking = track(capture, face_model, settings)
        tracking = replace(tracking, settings={**tracking.settings, "fingerprint": fingerprint})
        write_tracking(folder / "tracking", tracking)
        say(f"{name}: tracked with a median landmark residual of {tracking.residuals.nanmedian():.2f} pixels")
    if not scoring_exists(folder / "scoring"):
        capture = read_capture(folder / "capture")
        write_scoring(folder / "scoring", make_scoring(capture, tracking, face_model))
    _show_tracking(folder, tracking, face_model)
    return tracking


def _tracking_fingerprint(capture_hash: str, face_model: FaceModel, settings: TrackingSettings) -> str:
    content = [_TRACKING_RECIPE, capture_hash, face_model.name, face_model.content_hash, asdict(settings)]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _current_tracking(folder: Path, fingerprint: str) -> Tracking | None:
    if not (folder / "tracking.json").is_file():
        return None
    tracking = read_tracking(folder)
    return tracking if tracking.settings.get("fingerprint") == fingerprint else None


def _show_tracking(folder: Path, tracking: Tracking, face_model: FaceModel) -> None:
    """Write overlay.mp4 and the residual report, unless those there are newer than the tracking."""
    from mien.tracking import write_overlay, write_residual_report

    overlay, written = folder / "tracking" / "overlay.mp4", folder / "tracking" / "tracking.json"
    if overlay.is_file() and overlay.stat().st_mtime >= written.stat().st_mtime:
        return
    capture: Capture = read_capture(folder / "capture")
    write_residual_report(folder / "tracking", capture, tracking, face_model)
    write_overlay(overlay, capture, tracking, face_model)


def training_stage(
    workspace: Workspace, sequences: list[str], run: str, method: MethodConfig, settings: TrainSettings
) -> None:
    """Train a run on some sequences of the workspace; a finished or interrupted one goes on where it was."""
    sequence_name(Path(run), run)
    loaded = [read_sequence(workspace.sequence_dir(name)) for name in sequences]
    train(loaded, load_face_model(loaded[0].tracking.face_model), method, settings, workspace.run_dir(run))
    summary = read_training_summary(workspace.run_dir(run))
    say(f"{run}: {summary['gaussians']:,} Gaussians after {summary['steps']:,} steps in {summary['seconds']:.0f} s")


def evaluation_stage(workspace: Workspace, run: str) -> dict[str, Any]:
    """Evaluate a run on what it held out; returns the content of metrics.json."""
    run_dir = workspace.run_dir(run)
    metrics = evaluate(
        run_dir, [workspace.sequence_dir(entry["sequence"]) for entry in read_run_config(run_dir)["data"]]
    )
    for name, entry in metrics["protocols"].items():
        baselines = ", ".join(f"{key} {value['psnr']:.2f}" for key, value in entry["baselines"].items())
        say(
            f"{name} ({entry['split']}, {entry['frames']} frames): PSNR {entry['psnr']:.2f} dB whole frame, "
            f"{entry['head']['psnr']:.2f} head crop; baselines: {baselines}"
        )
    say(f"Look at {run_dir / 'report.html'}")
    return metrics


def drive_stage(run_dir: Path, sequence_dir: Path, out: Path, head_pose: bool = True, alone: bool = False) -> None:
    """Play a run's avatar with a sequence's tracking into an mp4, the driver's pictures beside it unless `alone`."""
    if out.suffix != ".mp4":
        raise UserError(f"{out}: cannot write {out.suffix or 'a file without ending'}; use .mp4")
    avatar, sequence = load_avatar(run_dir), read_sequence(sequence_dir)
    driver = sequence.tracking.face
    at_rest = neutral_of(driver[sequence.tracking.valid])
    bounds = avatar.face_model.expression_bounds
    driven = drive(driver, at_rest, avatar.subject, bounds, with_head_pose=head_pose)
    camera, white = run_camera(run_dir), torch.ones(3)

    @torch.no_grad()
    def picture(timestep: int) -> np.ndarray:
        gaussians = avatar.pose(driven[timestep]).gaussians.timestep(0)
        image = to_uint8(rasterize(gaussians, camera, white).image)
        return image if alone else side_by_side([np.asarray(sequence.capture.images[timestep, 0]), image])

    steps = range(sequence.capture.timesteps)
    pictures = (picture(timestep) for timestep in track_progress(steps, "Driving", len(steps)))
    write_video(out, pictures, sequence.capture.fps)
    say(f"{out}: {len(steps)} frames")
