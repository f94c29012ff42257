"""Figures of pictures against a target, computed alike for protocols and for pictures of other programs."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mien.evaluation.metrics import crop_to, l1, psnr, ssim
from mien.evaluation.perceptual import MIN_SIDE, Backbone, PerceptualDistance, load_perceptual
from mien.pictures import Box, to_uint8
from mien.threads import asked_threads

METRICS = ("psnr", "ssim", "l1", "perceptual")
_MAX_THREADS = 8
"""Default limit of the threads. Each thread needs some hundred megabytes for the perceptual metric's features."""
SSIM_WINDOW = "11x11 Gaussian window, sigma 1.5, zeros beyond the border"
PIXELS = "8 bits a channel, rounded"
"""The scored pixels: those that a png file would hold, so that files of any program are scored alike."""

Scores = Mapping[str, float]
"""`psnr`, `ssim`, `l1`, `perceptual`, and the same with the prefix `head_`."""


@dataclass(frozen=True)
class ScoreSettings:
    """Settings of the scoring: which figures, and how."""

    perceptual: bool = True
    """Whether to compute ST-LPIPS, which takes most of the time."""
    perceptual_frames: int = 32
    """Largest number of frames, evenly spread, on which ST-LPIPS is computed, 3 s each at 512x512. 0 means all
    frames."""
    threads: int = 0
    """Number of frames that are scored at a time. 0 means MIEN_THREADS or all cores. Figures do not depend on it."""
    backbone: Backbone = "st-lpips-alex"
    """Network of the perceptual metric."""


def perceptual_metric(settings: ScoreSettings) -> PerceptualDistance | None:
    """The perceptual metric, or None if it is not asked for."""
    return load_perceptual(settings.backbone) if settings.perceptual else None


def as_8_bit(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The image as a png file would hold it, converted back to 0..1."""
    return torch.from_numpy(to_uint8(image)).float() / 255


@torch.no_grad()
def score_pictures(
    pictures: Mapping[str, Float[Tensor, "h w 3"]],
    target: Float[Tensor, "h w 3"],
    crop: Box | None,
    metric: PerceptualDistance | None,
) -> dict[str, Scores]:
    """The figures of several pictures against one target, on the whole frame and on the head crop if it is given."""
    rows: dict[str, dict[str, float]] = {name: {} for name in pictures}
    parts = [("", None), *([("head_", crop)] if crop is not None else [])]
    for prefix, box in parts:
        cut = crop_to(target, box)
        small = min(cut.shape[:2]) < MIN_SIDE
        reference = metric.features(cut) if metric is not None and not small else None
        for name, picture in pictures.items():
            image, row = crop_to(picture, box), rows[name]
            row[f"{prefix}psnr"], row[f"{prefix}ssim"] = psnr(image, cut), ssim(image, cut)
            row[f"{prefix}l1"] = l1(image, cut)
            if metric is not None and reference is not None:
                row[f"{prefix}perceptual"] = metric.between(metric.features(image), reference)
    return dict(rows)


def mean_scores(rows: Sequence[Scores]) -> dict[str, Any]:
    """Means over the frames that have a figure, or None if no frame has it. Head-crop figures are under `head`."""

    def mean(name: str) -> float | None:
        known = [row[name] for row in rows if name in row]
        return fmean(known) if known else None

    whole = {name: mean(name) for name in METRICS}
    return {**whole, "head": {name: mean(f"head_{name}") for name in METRICS}}


def worker_threads(threads: int) -> int:
    """The number of frames to score at a time.

    Raises:
        UserError: MIEN_THREADS is not a number of threads.
    """
    if threads > 0:
        return threads
    return asked_threads() or min(_MAX_THREADS, os.cpu_count() or 1)
