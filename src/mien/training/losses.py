"""Losses that compare a rendering with its target: pure functions, means over the whole picture."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.avatar import Photometric
from mien.render.rendering import Rendering
from mien.training.photometric import WINDOW_RADIUS, Box, photometric_loss
from mien.training.sequence import Target


def picture_losses(rendering: Rendering, target: Target, weights: Photometric) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name; differentiable in the rendering."""
    # On a GPU the host would wait for the box, longer than the rest of the picture takes.
    box = _box_of_difference(rendering, target) if rendering.image.device.type == "cpu" else None
    losses = {
        "photometric": photometric_loss(rendering.image, target.picture, weights.l1_weight, weights.ssim_weight, box)
    }
    if weights.alpha_weight > 0:
        difference = rendering.alpha - target.matte.to(rendering.alpha.dtype) / 255
        losses["alpha"] = weights.alpha_weight * difference.abs().mean()
    return losses


def train_psnr(rendering: Rendering, target: Target) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, on the whole picture."""
    image, picture = rendering.image.detach(), target.picture
    if image.dtype == torch.float32 and image.device.type == "cpu":
        error = _native.mean_squared_difference(image.contiguous(), picture.contiguous())
    else:
        error = float((image - picture.to(image) / 255).square().mean())
    return -10 * math.log10(max(error, 1e-10))


def box_of_nonzero(values: Float[Tensor, "h w"]) -> Box:
    """The smallest box around all values that are not zero; width and height 0 where there are none."""
    if values.dtype == torch.float32 and values.device.type == "cpu":
        return _native.box_of_nonzero(values.contiguous())
    columns, rows = (values.ne(0).any(axis).nonzero()[:, 0] for axis in (0, 1))
    if len(columns) == 0:
        return 0, 0, 0, 0
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top


def _box_of_difference(rendering: Rendering, target: Target) -> Box:
    """Outside of this box both pictures show the background and nothing else, also to SSIM's windows."""
    boxes = [box for box in (target.box, box_of_nonzero(rendering.alpha.detach())) if box[2] > 0]
    if not boxes:
        return 0, 0, 0, 0
    left, top = (min(box[side] for box in boxes) for side in (0, 1))
    right, bottom = (max(box[side] + box[side + 2] for box in boxes) for side in (0, 1))
    margin = WINDOW_RADIUS + 1
    return left - margin, top - margin, right - left + 2 * margin, bottom - top + 2 * margin
