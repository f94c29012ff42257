"""The changes of Gaussians with the expression beside those of the mesh, and what holds them back."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig

_FEATURES = ("feature_color", "feature_opacity")
"""Names of the changes by features."""
BASES = ("color_basis", "opacity_basis", "offset_basis")
"""Names of the bases of linear changes, which are also those of the changes."""
APPEARANCE_WEIGHT = 0.1  # weight of the mean squared changes of colour and opacity by features


def change_penalties(config: GaussianAvatarsConfig, changes: Mapping[str, Tensor]) -> dict[str, Float[Tensor, ""]]:
    """The weighted mean squared changes over all Gaussians: linear ones as `expression`, features' as `appearance`."""
    kinds = (("expression", BASES, config.expression_weight), ("appearance", _FEATURES, APPEARANCE_WEIGHT))
    losses = {}
    for loss, names, weight in kinds:
        chosen = [changes[name] for name in names if name in changes]
        if chosen:
            losses[loss] = mean_squares(weight, *chosen)
    return losses


def mean_squares(weight: float, *tensors: Tensor) -> Float[Tensor, ""]:
    """The weighted sum of the mean squares of some tensors. Differentiable once."""
    return _MeanSquares.apply(weight, *tensors)  # pyright: ignore[reportReturnType]


class _MeanSquares(torch.autograd.Function):
    """One pass over each tensor forward, and one backward. Autograd's own needs four, and memory for each."""

    @staticmethod
    def forward(ctx: Any, weight: float, *tensors: Tensor) -> Tensor:
        ctx.weight = weight
        ctx.save_for_backward(*tensors)
        flat = [tensor.detach().flatten() for tensor in tensors]
        return weight * torch.stack([torch.dot(own, own) / own.numel() for own in flat]).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:
        factor = 2 * ctx.weight * grad_loss
        return None, *(tensor * (factor / tensor.numel()) for tensor in ctx.saved_tensors)
