"""Held-out pictures during a training: Fig. 13 of the supplement."""

from dataclasses import replace

import numpy as np
import torch

from mien.avatar.avatar import Avatar
from mien.avatar.settings import Progress
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, target_image
from mien.evaluation.metrics import crop_to, psnr
from mien.lab.analysis.context import Context
from mien.lab.analysis.result import Chart, PartResult, Picture, Table
from mien.lab.analysis.views import labeled
from mien.machine.progress import progress_bar
from mien.machine.threads import one_torch_thread
from mien.media.pictures import side_by_side, to_uint8
from mien.pages.plots import Axes, Series
from mien.render import rasterize
from mien.training.footage.frames import (
    Frame,
    FrameOrder,
    camera_extent,
    expression_rarity,
    spread_frames,
    training_frames,
)
from mien.training.footage.sequence import Targets
from mien.training.settings import resolved
from mien.training.trainer import TrainingData, pretrain, start, step

TIMES = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
"""Times of the snapshots, as fractions of the training."""
_FRAMES = 8
"""Largest number of held-out frames that are scored."""


def convergence(context: Context) -> PartResult:
    """Train once more for `options.steps` steps, and draw held-out frames at several times."""
    experiment = context.experiment()
    if experiment is None:
        raise UserError(
            f"{context.run_dir}: nothing was held out, so there is no picture to compare; train it with --split blocks"
        )
    context.say_how_long("convergence", 1)
    frames = spread_frames(experiment.held_out_frames, _FRAMES)
    steps = sorted({max(1, round(time * context.options.steps)) for time in TIMES})
    rows, tiles = [], [labeled(_head(experiment, frames[0], target_image(experiment, frames[0])), "truth")]
    for reached, gaussians, pictures in _snapshots(context, experiment, frames, steps):
        scores = [
            psnr(picture, target_image(experiment, frame), experiment.crop(frame))
            for frame, picture in zip(frames, pictures, strict=True)
        ]
        rows.append({"step": reached, "gaussians": gaussians, "head_psnr": round(float(np.mean(scores)), 3)})
        tiles.append(labeled(_head(experiment, frames[0], pictures[0]), f"step {reached}"))
    x, y, counts = (np.array([row[name] for row in rows], float) for name in ("step", "head_psnr", "gaussians"))
    near = next(row["step"] for row in rows if row["head_psnr"] >= max(y) - 1)
    return PartResult(
        {"steps": context.options.steps, "rows": rows},
        (
            f"The head crop has {y[-1]:.1f} dB after {int(x[-1]):,} steps. It comes within 1 dB of its best value by "
            f"step {near:,}.",
        ),
        (Table(("Step", "Gaussians", "PSNR of the head, dB"), tuple(tuple(row.values()) for row in rows)),),
        (
            Chart("convergence-psnr", "Fig. 13: PSNR of the head", (Series("this run", x, y),), Axes("step", "dB")),
            Chart(
                "convergence-points",
                "Number of points",
                (Series("this run", x, counts),),
                Axes("step", "points", from_zero=True),
            ),
        ),
        (Picture("convergence", side_by_side(tiles), "A held-out frame: the truth, then the avatar as it learns."),),
        notes=(
            "This training has the run's data, settings and seed, with all schedules shortened to its steps. Faces of "
            "held-out frames are those of the tracker. A stopped training of this part starts again.",
        ),
    )


def _snapshots(
    context: Context, experiment: Experiment, frames: list[Frame], steps: list[int]
) -> list[tuple[int, int, list[torch.Tensor]]]:
    """Step, number of Gaussians and pictures of `frames` at each of some steps, from one training."""
    # This method fills no sides.
    settings = resolved(replace(context.settings, steps=context.options.steps), filled=False)
    sequences = context.sequences
    trained = training_frames(sequences, settings)
    weights = expression_rarity(sequences, trained) if settings.frame_order == "rare" else None
    order = FrameOrder(trained, settings.seed, weights)
    model, config = context.avatar.face_model, context.avatar.config
    parts_of = model if config.photometric.needs_parts else None
    like, cleaned = torch.zeros(()), settings.edges == "cleaned"
    targets = tuple(
        Targets(one, settings.resolution, len(sequences), like, parts_of, cleaned=cleaned) for one in sequences
    )
    data = TrainingData(order, targets, camera_extent(sequences, trained))
    found = []
    state = start(sequences, model, config, settings)
    with one_torch_thread():
        pretrain(state, settings, progress_bar)
    with one_torch_thread(), progress_bar("convergence", settings.steps) as advance:
        while state.step < settings.steps:
            before = state.step
            step(state, data, settings)
            advance(state.step - before)
            progress = Progress(before, settings.steps, order.at(before)[1], data.extent, state.step - before)
            if progress.completes(steps):
                pictures = [drawn(state.avatar, experiment, frame, progress) for frame in frames]
                found.append((state.step, len(state.avatar.gaussian_store()), pictures))
    return found


@torch.no_grad()
def drawn(avatar: Avatar, experiment: Experiment, frame: Frame, progress: Progress) -> torch.Tensor:
    """The avatar's picture of a frame, at this point of its training."""
    face = experiment.sequences[frame.sequence].tracking.face[frame.timestep]
    gaussians = avatar.pose(face, progress).gaussians.timestep(0)
    return rasterize(gaussians, experiment.camera(frame), torch.ones(3)).image


def _head(experiment: Experiment, frame: Frame, image: torch.Tensor) -> np.ndarray:
    return to_uint8(crop_to(image, experiment.crop(frame)))
