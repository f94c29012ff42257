"""The figures of an evaluation that come from training pictures: their mean, and how well the avatar draws them."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import psnr
from mien.evaluation.scoring import as_8_bit
from mien.machine.parallel import stream_in_threads
from mien.training.footage.frames import Frame, spread_frames


@dataclass(frozen=True, eq=False)
class TrainedFrames:
    """The means of the training frames, and the avatar's scores on some of them."""

    means: dict[Frame, Float[Tensor, "h w 3"]]
    """The mean target of each sequence and camera. The keys have timestep 0. Empty if it was not asked for."""
    psnr: dict[Frame, tuple[float, float]]
    """PSNR of the avatar on the whole frame and on the head crop of some frames."""


@torch.no_grad()
def look_at_trained(
    experiment: Experiment, scored: int, threads: int | None = None, *, mean: bool = True
) -> TrainedFrames:
    """Look at the training frames of an experiment. Each picture is read once.

    Args:
        experiment: The experiment.
        scored: Largest number of frames, evenly spread, on which the avatar is scored. 0 means none.
        threads: Number of frames that are read at a time; by default, MIEN_THREADS or all cores. It changes no figure.
        mean: Whether to compute the mean target, for which all frames are read.
    """
    every = experiment.training_frames
    judged = spread_frames(every, scored) if scored else []
    chosen = set(judged)

    def jobs() -> Iterator[tuple[Frame, Tensor | None]]:
        # Rendering runs here, frame by frame; all else runs in threads.
        for frame in every if mean else judged:
            yield frame, avatar_image(experiment, frame) if frame in chosen else None

    def look(job: tuple[Frame, Tensor | None]) -> tuple[Frame, Tensor, tuple[float, float] | None]:
        frame, drawn = job
        target = target_image(experiment, frame)
        if drawn is None:
            return frame, target, None
        image = as_8_bit(drawn)
        return frame, target, (psnr(image, target), psnr(image, target, experiment.crop(frame)))

    sums: dict[Frame, Tensor] = {}
    counts: dict[Frame, int] = {}
    figures: dict[Frame, tuple[float, float]] = {}
    # Sums are taken here, in the order of the frames.
    for frame, target, found in stream_in_threads(look, jobs(), threads):
        if found is not None:
            figures[frame] = found
        if mean:
            key = frame._replace(timestep=0)
            sums[key] = sums[key].add_(target) if key in sums else target
            counts[key] = counts.get(key, 0) + 1
    return TrainedFrames({key: total / counts[key] for key, total in sums.items()}, figures)
