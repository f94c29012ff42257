"""Losses that compare a rendering with its target: pure functions, means over the whole picture."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from mien.avatar import Photometric
from mien.render.rendering import Rendering
from mien.training.photometric import photometric_loss


def picture_losses(
    rendering: Rendering, target: UInt8[Tensor, "h w 3"], matte: UInt8[Tensor, "h w"], weights: Photometric
) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name; differentiable in the rendering."""
    losses = {"photometric": photometric_loss(rendering.image, target, weights.l1_weight, weights.ssim_weight)}
    if weights.alpha_weight > 0:
        difference = rendering.alpha - matte.to(rendering.alpha.dtype) / 255
        losses["alpha"] = weights.alpha_weight * difference.abs().mean()
    return losses


def train_psnr(rendering: Rendering, target: UInt8[Tensor, "h w 3"]) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, on the whole picture."""
    difference = rendering.image.detach() - target.to(rendering.image.dtype) / 255
    return float(-10 * torch.log10((difference * difference).mean().clamp_min(1e-10)))
