"""Losses that compare a rendering with its target: pure functions, means over the whole picture."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar import Photometric
from mien.render.rendering import Rendering
from mien.training.photometric import WINDOW_RADIUS, Box, photometric_loss
from mien.training.sequence import Target


def picture_losses(rendering: Rendering, target: Target, weights: Photometric) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name; differentiable in the rendering."""
    box = _box_of_difference(rendering, target)
    losses = {
        "photometric": photometric_loss(rendering.image, target.picture, weights.l1_weight, weights.ssim_weight, box)
    }
    if weights.alpha_weight > 0:
        difference = rendering.alpha - target.matte.to(rendering.alpha.dtype) / 255
        losses["alpha"] = weights.alpha_weight * difference.abs().mean()
    return losses


def train_psnr(rendering: Rendering, target: Target) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, on the whole picture."""
    difference = rendering.image.detach() - target.picture.to(rendering.image.dtype) / 255
    return float(-10 * torch.log10((difference * difference).mean().clamp_min(1e-10)))


def _box_of_difference(rendering: Rendering, target: Target) -> Box:
    """Outside of this box both pictures show the background and nothing else, also to SSIM's windows."""
    alpha = rendering.alpha.detach()
    columns, rows = (alpha.amax(axis).nonzero()[:, 0] for axis in (0, 1))
    left, top, width, height = target.box
    edges = [left, top, left + width, top + height] if width else []
    if len(columns):
        drawn = [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]
        edges = [*map(min, edges[:2], drawn[:2]), *map(max, edges[2:], drawn[2:])] if edges else drawn
    if not edges:
        return 0, 0, 0, 0
    left, top, right, bottom = edges
    margin = WINDOW_RADIUS + 1
    return left - margin, top - margin, right - left + 2 * margin, bottom - top + 2 * margin
