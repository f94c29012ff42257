"""Losses that compare a rendering with its target. They are pure functions, and means over the whole picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import is_native, native, recycled, unpacked
from mien.avatar.settings import PerceptualLoss, Photometric
from mien.media.pictures import Box
from mien.perceptual.features import TrainingFeatures, load_training_features
from mien.render.rendering import Rendering
from mien.training.footage.sequence import Target
from mien.training.photometric import photometric_loss

_LEAST_SIDE = 16
"""Smallest side of what trained features are taken of, in pixels: that of the smallest picture."""


def picture_losses(rendering: Rendering, target: Target, weights: Photometric) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name. Differentiable in the rendering."""
    # Outside the target's box and the drawn pixels, both pictures show only the background.
    photometric = photometric_loss(
        rendering.image, target.picture, weights.l1_weight, weights.ssim_weight, target.box,
        rendering.alpha, target.parts, weights.part_weight,
    )  # fmt: skip
    losses = {"photometric": photometric}
    if weights.alpha_weight > 0:
        losses["alpha"] = alpha_loss(rendering.alpha, target.matte, weights.alpha_weight)
    return losses


def alpha_loss_reference(alpha: Float[Tensor, "h w"], matte: UInt8[Tensor, "h w"], weight: float) -> Float[Tensor, ""]:
    """`alpha_loss` in plain PyTorch, for any dtype and device."""
    return weight * (alpha - matte.to(alpha) / 255).abs().mean()


@native(alpha_loss_reference)
def alpha_loss(alpha: Float[Tensor, "h w"], matte: UInt8[Tensor, "h w"], weight: float) -> Float[Tensor, ""]:
    """`weight` times the mean absolute difference between alpha and a matte (0..255). Native for float32 on a CPU."""
    return _AlphaLoss.apply(alpha, matte, weight)  # pyright: ignore[reportReturnType]


class _AlphaLoss(torch.autograd.Function):
    """One native pass computes value and gradient; `backward` only scales the gradient."""

    @staticmethod
    def forward(ctx: Any, alpha: Float[Tensor, "h w"], matte: UInt8[Tensor, "h w"], weight: float) -> Tensor:
        gradient, loss = recycled(*alpha.shape), torch.empty(())
        values, target, *filled = unpacked(alpha.detach().contiguous(), matte.contiguous(), gradient, loss)
        _native.absolute_difference(values, target, weight, *filled)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient if float(grad_loss) == 1 else gradient * grad_loss, None, None


@dataclass(frozen=True, eq=False)
class PerceptualGoal:
    """What the perceptual loss of one step compares the rendering with."""

    crop: tuple[slice, slice]
    """Rows and columns of the picture."""
    features: Sequence[Float[Tensor, "1 _ _ _"]]
    """Trained features of the target in the crop."""


@torch.no_grad()
def perceptual_goal(target: Target, settings: PerceptualLoss, random: torch.Generator) -> PerceptualGoal:
    """The features of the target's box, or of a crop drawn at random. They do not depend on the avatar."""
    whole = settings.region == "person"
    left, top, width, height = person_box(target) if whole else drawn_crop(target, settings.crop, random)
    crop = (slice(top, top + height), slice(left, left + width))
    picture = target.picture[crop].to(target.background) / 255
    return PerceptualGoal(crop, _features(picture, settings).features(picture))


def perceptual_loss(rendering: Rendering, goal: PerceptualGoal, settings: PerceptualLoss) -> Float[Tensor, ""]:
    """The weighted distance of trained features on the goal's crop. Differentiable in the rendering."""
    image = rendering.image[goal.crop]
    share = 1.0 if settings.region == "person" else image.numel() / rendering.image.numel()
    return settings.weight * share * _features(image, settings).distance(image, goal.features)


def _features(image: Tensor, settings: PerceptualLoss) -> TrainingFeatures:
    return load_training_features(str(image.device), image.dtype, settings.blocks)


def person_box(target: Target) -> Box:
    """The box of what is not background. It has at least 16 pixels a side, as far as the picture does."""
    full_height, full_width = target.picture.shape[:2]
    left, top, width, height = target.box
    width, height = min(max(width, _LEAST_SIDE), full_width), min(max(height, _LEAST_SIDE), full_height)
    return min(left, full_width - width), min(top, full_height - height), width, height


def drawn_crop(target: Target, side: int, random: torch.Generator) -> Box:
    """A square of `side` pixels inside the picture, or less if the picture is smaller.

    Each part of the target, and the box of what is not background, is chosen equally often. The square's centre is
    anywhere in the chosen box; a square that reaches beyond the picture's border is moved inside.
    """
    full_height, full_width = target.picture.shape[:2]
    boxes = [*target.parts, target.box]
    choice, across, down = torch.rand(3, generator=random, dtype=torch.float64).tolist()
    left, top, width, height = boxes[int(choice * len(boxes))]
    side_x, side_y = min(side, full_width), min(side, full_height)
    x, y = int(left + across * width - side / 2), int(top + down * height - side / 2)
    return min(max(x, 0), full_width - side_x), min(max(y, 0), full_height - side_y), side_x, side_y


def train_psnr(rendering: Rendering, target: Target) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, over the whole picture."""
    image, picture = rendering.image.detach(), target.picture
    if is_native(image):
        error = _native.mean_squared_difference(image.contiguous(), picture.contiguous())
    else:
        error = float((image - picture.to(image) / 255).square().mean())
    return -10 * math.log10(max(error, 1e-10))
