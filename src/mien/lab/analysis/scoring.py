"""Scores of held-out frames, for parts that compare short trainings."""

from statistics import fmean

import torch

from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.scoring import score_pictures
from mien.perceptual.distance import PerceptualDistance, load_perceptual
from mien.training.footage.frames import spread_frames

METRICS = ("head_psnr", "head_ssim", "head_perceptual")
_FRAMES = 16
"""Largest number of held-out frames that are scored."""


def perceptual_metric() -> tuple[PerceptualDistance | None, list[str]]:
    """ST-LPIPS, or None and a note that says why it is missing."""
    try:
        return load_perceptual(), []
    except UserError as error:
        return None, [f"ST-LPIPS was not computed: {error}."]


@torch.no_grad()
def held_out_scores(experiment: Experiment | None, metric: PerceptualDistance | None) -> dict[str, float | None]:
    """Means of `METRICS` over held-out frames. None where nothing was held out, or pictures are too small."""
    rows = []
    for frame in [] if experiment is None else spread_frames(experiment.held_out_frames, _FRAMES):
        assert experiment is not None
        pictures = {"avatar": avatar_image(experiment, frame)}
        rows.append(score_pictures(pictures, target_image(experiment, frame), experiment.crop(frame), metric)["avatar"])
    means: dict[str, float | None] = {}
    for name in METRICS:
        values = [row[name] for row in rows if name in row]
        means[name] = round(fmean(values), 4) if values else None
    return means
