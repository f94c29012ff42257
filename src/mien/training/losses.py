"""Losses that compare a rendering with its target. They are pure functions, and means over the whole picture."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.avatar import Photometric
from mien.render.rendering import Rendering
from mien.training.photometric import photometric_loss
from mien.training.sequence import Target


def picture_losses(rendering: Rendering, target: Target, weights: Photometric) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name. Differentiable in the rendering."""
    # Outside the target's box and the drawn pixels, both pictures show only the background.
    photometric = photometric_loss(
        rendering.image, target.picture, weights.l1_weight, weights.ssim_weight, target.box, drawn=rendering.alpha
    )
    losses = {"photometric": photometric}
    if weights.alpha_weight > 0:
        difference = rendering.alpha - target.matte.to(rendering.alpha.dtype) / 255
        losses["alpha"] = weights.alpha_weight * difference.abs().mean()
    return losses


def train_psnr(rendering: Rendering, target: Target) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, over the whole picture."""
    image, picture = rendering.image.detach(), target.picture
    if image.dtype == torch.float32 and image.device.type == "cpu":
        error = _native.mean_squared_difference(image.contiguous(), picture.contiguous())
    else:
        error = float((image - picture.to(image) / 255).square().mean())
    return -10 * math.log10(max(error, 1e-10))
