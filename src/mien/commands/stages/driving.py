"""Avatar + motion -> video, as the command line runs it."""

from pathlib import Path

import numpy as np
import torch

from mien.avatar import load_avatar, neutral_of
from mien.capture.video import write_video
from mien.errors import UserError
from mien.evaluation.driving import drive
from mien.evaluation.pictures import side_by_side, to_uint8
from mien.progress import say, track_progress
from mien.render import rasterize
from mien.training import read_sequence
from mien.training.run import run_camera


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
