"""The penalties of GaussianAvatars on centres and scales in triangle units (CVPR 2024, section 3.4)."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import left_to_autograd, native, recycled, recycled_like, times, unpacked

_Pair = tuple[float, float]
"""A value for centres, and one for scales."""


def triangle_penalties_reference(
    means: Float[Tensor, "n 3"],
    log_scales: Float[Tensor, "n 3"],
    radii: Int[Tensor, " n"],
    thresholds: _Pair,
    weights: _Pair,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """`triangle_penalties` in plain PyTorch, any dtype and device."""
    in_view = radii > 0
    share = in_view / in_view.sum().clamp_min(1)
    too_far = torch.relu(torch.linalg.vector_norm(means, dim=-1) - thresholds[0])
    too_large = torch.linalg.vector_norm(torch.relu(log_scales.exp() - thresholds[1]), dim=-1)
    return weights[0] * (too_far * share).sum(), weights[1] * (too_large * share).sum()


@native(triangle_penalties_reference, gpu="mien.avatar.ops.triangle_penalties_gpu")
def triangle_penalties(
    means: Float[Tensor, "n 3"],
    log_scales: Float[Tensor, "n 3"],
    radii: Int[Tensor, " n"],
    thresholds: _Pair,
    weights: _Pair,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Weighted means, over the visible Gaussians, of how far centres and scales exceed their thresholds (section 3.4).

    Lengths are in units of the triangle's size. `thresholds` and `weights` hold the value for centres, then for scales.
    Differentiable in `means` and `log_scales`; native for float32 on a CPU.
    """
    return _TrianglePenalties.apply(means, log_scales, radii, thresholds, weights)


class _TrianglePenalties(torch.autograd.Function):
    """Values and gradients come from one native pass; `backward` only scales the gradients."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, log_scales: Tensor, radii: Tensor, thresholds: _Pair, weights: _Pair):
        inputs = unpacked(*(tensor.contiguous() for tensor in (means, log_scales, radii)))
        gradients, values = (recycled_like(means), recycled_like(log_scales)), (recycled(), recycled())
        _native.triangle_penalties(thresholds, weights, *inputs, *unpacked(*gradients, *values))
        ctx.inputs, ctx.gradients = (means, log_scales), gradients
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *output_gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *left_to_autograd(ctx.inputs, [*map(times, ctx.gradients, output_gradients)]), None, None, None
