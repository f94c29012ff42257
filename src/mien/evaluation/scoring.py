"""Figures of pictures against a target, computed alike for protocols and for pictures of other programs."""

import os
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Box
from mien.evaluation.metrics import Border, Windows, crop_to, l1, psnr, ssim
from mien.face.head_parts import PARTS
from mien.machine.threads import asked_threads
from mien.media.pictures import to_uint8
from mien.pages.pages import METRICS
from mien.perceptual import Backbone
from mien.perceptual.distance import MIN_SIDE, PerceptualDistance, load_perceptual
from mien.perceptual.lpips import Lpips, load_lpips

LPIPS = "lpips"
"""Exact LPIPS, which stands beside them if its user has the weights."""
_MAX_THREADS = 8
"""Default limit of the threads. Each thread needs some hundred megabytes for the perceptual metric's features."""
SSIM_WINDOW = "11x11 Gaussian window, sigma 1.5, zeros beyond the border"
SSIM_WINDOWS: dict[Border, str] = {
    "zeros": SSIM_WINDOW,
    "inside": "11x11 Gaussian window, sigma 1.5, only where it lies inside the picture",
}
"""Words for the windows of SSIM, by their border."""
PIXELS = "8 bits a channel, rounded"
"""The scored pixels: those that a png file would hold, so that files of any program are scored alike."""

PART_SIDE = 64
"""Smallest side at which ST-LPIPS compares the crops of eyes and mouth, in pixels. Smaller crops are enlarged."""

Scores = Mapping[str, float]
"""`psnr`, `ssim`, `l1`, `perceptual`, and the same with the prefixes `head_`, `eyes_` and `mouth_`."""


@dataclass(frozen=True)
class ScoreSettings:
    """Settings of the scoring: which figures, and how."""

    perceptual: bool = True
    """Whether to compute ST-LPIPS, which takes most of the time."""
    perceptual_frames: int = 24
    """Largest number of frames, evenly spread, on which ST-LPIPS is computed, 3 s each at 512x512. 0 means all
    frames."""
    threads: int = 0
    """Number of frames that are scored at a time. 0 means MIEN_THREADS or all cores. Figures do not depend on it."""
    backbone: Backbone = "st-lpips-alex"
    """Network of the perceptual metric."""
    lpips_weights: Path | None = None
    """Torchvision's file of AlexNet or VGG16, with which exact LPIPS is computed as well, on the same frames. None
    leaves it out."""


def perceptual_metric(settings: ScoreSettings) -> PerceptualDistance | None:
    """The perceptual metric, or None if it is not asked for."""
    return load_perceptual(settings.backbone) if settings.perceptual else None


def lpips_metric(settings: ScoreSettings) -> Lpips | None:
    """Exact LPIPS, or None if no file of weights is given."""
    return None if settings.lpips_weights is None else load_lpips(settings.lpips_weights)


def as_8_bit(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The image as a png file would hold it, converted back to 0..1."""
    return torch.from_numpy(to_uint8(image)).float() / 255


@torch.no_grad()
def score_pictures(
    pictures: Mapping[str, Float[Tensor, "h w 3"]],
    target: Float[Tensor, "h w 3"],
    crop: Box | None,
    metric: PerceptualDistance | None,
    parts: Mapping[str, Box] = MappingProxyType({}),
    lpips: Lpips | None = None,
    border: Border = "zeros",
    compared: Container[str] | None = None,
) -> dict[str, Scores]:
    """The figures of several pictures, 0..1, against one target: on the whole frame, the head `crop` and the `parts`.

    `metric` (ST-LPIPS) and `lpips` skip a picture or a head that is too small for them, and enlarge parts with a side
    below `PART_SIDE` to it. They judge the pictures that `compared` names, or all.
    """
    metrics = [(name, each) for name, each in (("perceptual", metric), (LPIPS, lpips)) if each is not None]
    rows: dict[str, dict[str, float]] = {name: {} for name in pictures}
    boxes = [("", None, 0), *([("head_", crop, 0)] if crop is not None else [])]
    boxes += [(f"{name}_", box, PART_SIDE) for name, box in parts.items()]
    for prefix, box, least in boxes:
        cut = crop_to(target, box)
        windows = Windows.of(cut)
        judged = enlarged(cut, least)
        large = min(judged.shape[:2]) >= MIN_SIDE
        references = [(key, each, each.features(judged)) for key, each in metrics] if large else []
        for name, picture in pictures.items():
            image, row = crop_to(picture, box), rows[name]
            row[f"{prefix}psnr"], row[f"{prefix}ssim"] = psnr(image, cut), ssim(image, windows, border)
            row[f"{prefix}l1"] = l1(image, cut)
            for key, each, reference in references if compared is None or name in compared else ():
                row[f"{prefix}{key}"] = each.between(each.features(enlarged(image, least)), reference)
    return dict(rows)


def mean_scores(rows: Sequence[Scores]) -> dict[str, Any]:
    """Means over the frames that have a figure, or None if no frame has it.

    Figures of the head crop are under `head`. Those of the crops of eyes and mouth are under `eyes` and `mouth`, if any
    frame has them.
    """

    def mean(name: str) -> float | None:
        known = [row[name] for row in rows if name in row]
        return fmean(known) if known else None

    metrics = (*METRICS, LPIPS) if any(LPIPS in row for row in rows) else METRICS
    whole = {name: mean(name) for name in metrics}
    seen = [part for part in PARTS if any(f"{part}_psnr" in row for row in rows)]
    return {**whole, **{part: {name: mean(f"{part}_{name}") for name in metrics} for part in ("head", *seen)}}


def enlarged(image: Float[Tensor, "h w 3"], least: int) -> Float[Tensor, "y x 3"]:
    """The image, enlarged by bicubic interpolation until its shorter side has at least `least` pixels."""
    factor = least / min(image.shape[:2])
    if factor <= 1:
        return image
    size = (max(round(image.shape[1] * factor), least), max(round(image.shape[0] * factor), least))
    larger = cv2.resize(np.ascontiguousarray(image.numpy()), size, interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(larger).clamp(0, 1)


def worker_threads(threads: int) -> int:
    """The number of frames to score at a time."""
    if threads > 0:
        return threads
    return asked_threads() or min(_MAX_THREADS, os.cpu_count() or 1)
