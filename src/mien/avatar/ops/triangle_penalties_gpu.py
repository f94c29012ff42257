"""`triangle_penalties` in kernels for a GPU: two launches forward and one backward."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.kernels import blocks, launch

_BLOCK = 256


def triangle_penalties(
    means: Tensor, log_scales: Tensor, radii: Tensor, thresholds: tuple[float, float], weights: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """`mien.avatar.ops.triangle_penalties.triangle_penalties`."""
    return _Penalties.apply(means, log_scales, radii, thresholds, weights)


class _Penalties(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, log_scales: Tensor, radii: Tensor, thresholds: Any, weights: Any) -> Any:
        means, log_scales, radii = means.contiguous(), log_scales.contiguous(), radii.contiguous()
        n, programs = len(means), blocks(len(means), _BLOCK)
        parts, values = means.new_empty(3, programs), means.new_empty(3)
        if n > 0:
            launch(_sums, programs, means, log_scales, radii, parts, n, programs, *thresholds, BLOCK=_BLOCK)
        launch(_weighted_means, 1, parts, values, programs, *weights, BLOCK=_BLOCK)
        ctx.save_for_backward(means, log_scales, radii, values)
        ctx.fixed = (*thresholds, *weights)
        return values[0], values[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_position: Tensor, of_scale: Tensor) -> tuple[Tensor | None, ...]:
        means, log_scales, radii, values = ctx.saved_tensors
        by_means, by_scales = torch.empty_like(means), torch.empty_like(log_scales)
        if len(means) > 0:
            launch(
                _gradients, blocks(len(means), _BLOCK), means, log_scales, radii, values, of_position.contiguous(),
                of_scale.contiguous(), by_means, by_scales, len(means), *ctx.fixed, BLOCK=_BLOCK,
            )  # fmt: skip
        return by_means, by_scales, None, None, None


@no_type_check
@triton.jit
def _excess(means, log_scales, radii, n, farthest, largest, BLOCK: tl.constexpr):
    """Rows of a block, whether they are drawn, lengths and what of lengths and of scales exceeds the thresholds."""
    row, axis = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4)
    at, there = 3 * row[:, None] + axis[None, :], (row < n)[:, None] & (axis < 3)[None, :]
    drawn = tl.load(radii + row, mask=row < n, other=0) > 0
    center, raw = tl.load(means + at, mask=there, other=0.0), tl.load(log_scales + at, mask=there, other=-1e4)
    length, scale = tl.sqrt(tl.sum(center * center, 1)), tl.exp(raw)
    # A comparison with NaN is false, so NaN stays.
    far = tl.where(length - farthest < 0, 0.0, length - farthest)
    large = tl.where(scale - largest < 0, 0.0, scale - largest)
    return at, there, drawn, center, length, far, scale, tl.where(there, large, 0.0)


@no_type_check
@triton.jit
def _sums(means, log_scales, radii, parts, n, programs, farthest, largest, BLOCK: tl.constexpr):
    _, _, drawn, _, _, far, _, large = _excess(means, log_scales, radii, n, farthest, largest, BLOCK)
    at = parts + tl.program_id(0)
    tl.store(at, tl.sum(tl.where(drawn, far, 0.0), 0))
    tl.store(at + programs, tl.sum(tl.where(drawn, tl.sqrt(tl.sum(large * large, 1)), 0.0), 0))
    tl.store(at + 2 * programs, tl.sum(tl.where(drawn, 1.0, 0.0), 0))


@no_type_check
@triton.jit
def _weighted_means(parts, values, programs, by_position, by_scale, BLOCK: tl.constexpr):
    one = tl.arange(0, BLOCK)
    nothing = tl.zeros([BLOCK], parts.dtype.element_ty)
    far, large, drawn = nothing, nothing, nothing
    for first in range(0, programs, BLOCK):
        at, there = parts + first + one, first + one < programs
        far += tl.load(at, mask=there, other=0.0)
        large += tl.load(at + programs, mask=there, other=0.0)
        drawn += tl.load(at + 2 * programs, mask=there, other=0.0)
    count = tl.maximum(tl.sum(drawn, 0), 1.0)
    tl.store(values, by_position * tl.sum(far, 0) / count)
    tl.store(values + 1, by_scale * tl.sum(large, 0) / count)
    tl.store(values + 2, count)


@no_type_check
@triton.jit
def _gradients(
    means, log_scales, radii, values, of_position, of_scale, by_means, by_scales, n, farthest, largest, by_position,
    by_scale, BLOCK: tl.constexpr,
):  # fmt: skip
    at, there, drawn, center, length, far, scale, large = _excess(means, log_scales, radii, n, farthest, largest, BLOCK)
    share = tl.where(drawn, 1.0 / tl.load(values + 2), 0.0)
    position = (
        tl.load(of_position) * by_position * share * tl.where(far == 0, 0.0, 1.0 / tl.where(far == 0, 1.0, length))
    )
    total = tl.sqrt(tl.sum(large * large, 1))
    size = tl.load(of_scale) * by_scale * share * tl.where(total == 0, 0.0, 1.0 / tl.where(total == 0, 1.0, total))
    tl.store(by_means + at, center * position[:, None], mask=there)
    tl.store(by_scales + at, large * scale * size[:, None], mask=there)
