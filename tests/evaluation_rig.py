"""Write two sequences, each seen by two cameras, and runs of them, to check that evaluation tells the cameras apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mien.avatar import DEFAULT_METHOD, FaceTuning
from mien.capture import read_capture_hash, write_capture
from mien.evaluation.experiment import Experiment
from mien.pictures import to_uint8
from mien.render import rasterize
from mien.render.camera_paths import orbit
from mien.tracking import write_scoring, write_tracking
from mien.training import TrainSettings, read_sequence, train
from mien.training.footage.sequence import Sequence
from plain_settings import plain_config


def two_cameras(experiment: Experiment, name: str) -> Sequence:
    """Return the experiment's sequence under another name, with a second camera that looks from the side."""
    sequence = experiment.sequences[0]
    first = sequence.tracking.cameras[0]
    second = orbit(first, torch.tensor([0.0, 0.0, -0.5]), 0.5)
    capture = sequence.capture
    images, mattes = (np.repeat(array, 2, axis=1) for array in (capture.images, capture.mattes))
    with torch.no_grad():
        for timestep in range(capture.timesteps):
            posed = experiment.avatar.pose(experiment.faces[0][timestep]).gaussians.timestep(0)
            rendering = rasterize(posed, second, torch.zeros(3))
            mattes[timestep, 1] = (rendering.alpha * 255).round().numpy()
            images[timestep, 1] = to_uint8(rendering.image / rendering.alpha.clamp_min(1e-3)[..., None])
    tracking = sequence.tracking
    return Sequence(
        name,
        replace(
            capture,
            name=name,
            camera_ids=("front", "side"),
            images=images,
            mattes=mattes,
            landmarks=np.repeat(capture.landmarks, 2, axis=1),
            valid=np.repeat(capture.valid, 2, axis=1),
            principal_point=np.repeat(capture.principal_point, 2, axis=0),
            source={"file": f"{name}.mp4"},
        ),
        replace(
            tracking,
            cameras=(first, second),
            neck_lines=tracking.neck_lines.repeat(1, 2, 1),
            residuals=tracking.residuals.repeat(1, 2),
        ),
        mattes,
    )


def write_sequence(root: Path, experiment: Experiment, sequence: Sequence) -> Path:
    """Write a sequence into a workspace, and return its folder."""
    folder = root / "sequences" / sequence.name
    crops = np.repeat(experiment.scorings[0].crops, len(sequence.capture.camera_ids), axis=1)
    write_capture(folder / "capture", sequence.capture)
    write_tracking(folder / "tracking", sequence.tracking)
    scoring = replace(experiment.scorings[0], masks=sequence.scoring, crops=crops)
    write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))
    return folder


def write_run(run_dir: Path, experiment: Experiment, folders: list[Path], settings: TrainSettings) -> None:
    """Train some sequences for a few steps."""
    config = plain_config(DEFAULT_METHOD, face_tuning=FaceTuning(enabled=False))
    train([read_sequence(folder) for folder in folders], experiment.avatar.face_model, config, settings, run_dir)
