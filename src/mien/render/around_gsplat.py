"""Kernels between mien's Gaussians and gsplat's own kernels: each is one launch."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.gaussians import SH_C0
from mien.kernels import blocks, launch
from mien.render.projection import MIN_ALPHA

_BLOCK = 256
_SH_C0 = tl.constexpr(SH_C0)
_MIN_ALPHA = tl.constexpr(MIN_ALPHA)


def constant_colors(sh: Tensor) -> Tensor:
    """Colours [1, n, 3] of constant coefficients [n, 1, 3], not below 0."""
    return _Constant.apply(sh)  # pyright: ignore[reportReturnType]


def view_directions(means: Tensor, viewmat: Tensor) -> Tensor:
    """Directions [1, n, 3] from a camera to centres, not normalised. Differentiable in both."""
    return _Directions.apply(means, viewmat)  # pyright: ignore[reportReturnType]


@torch.no_grad()
def three_sigma(
    conics: Tensor, means2d: Tensor, opacities: Tensor, radii: Tensor, width: int, height: int
) -> Tensor:  # fmt: skip
    """3 sigma of the longer axis in pixels [n]; 0 for Gaussians that reach no pixel.

    gsplat's own radii [1, n, 2] are boxes that depend on opacity. They are rounded up, so some of them reach into the
    picture although their Gaussians do not. `project_splats` has the exact test, which is repeated here.
    """
    n = len(opacities)
    result = torch.empty(n, dtype=torch.int32, device=opacities.device)
    given = (one.detach().contiguous() for one in (conics, means2d, opacities, radii))
    launch(_three_sigma, blocks(n, _BLOCK), *given, result, n, float(width), float(height), BLOCK=_BLOCK)
    return result


class _Constant(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor) -> Tensor:
        sh, colors = sh.contiguous(), sh.new_empty(1, len(sh), 3)
        launch(_constant, blocks(colors.numel(), _BLOCK), sh, colors, colors.numel(), BLOCK=_BLOCK)
        ctx.save_for_backward(colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_colors: Tensor) -> Tensor:
        (colors,) = ctx.saved_tensors
        result, size = colors.new_empty(colors.shape[1], 1, 3), colors.numel()
        launch(_constant_backward, blocks(size, _BLOCK), colors, by_colors.contiguous(), result, size, BLOCK=_BLOCK)
        return result


class _Directions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, viewmat: Tensor) -> Tensor:
        means, viewmat = means.contiguous(), viewmat.contiguous()
        directions = means.new_empty(1, *means.shape)
        launch(_directions, blocks(len(means), _BLOCK), means, viewmat, directions, len(means), BLOCK=_BLOCK)
        ctx.save_for_backward(viewmat)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_directions: Tensor) -> tuple[Tensor | None, Tensor | None]:
        (viewmat,), result = ctx.saved_tensors, None
        if ctx.needs_input_grad[1]:
            result = torch.empty_like(viewmat)
            launch(_camera_backward, 1, viewmat, by_directions.sum((0, 1)), result)
        return by_directions.squeeze(0), result


@no_type_check
@triton.jit
def _constant(sh, colors, size, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    value = tl.load(sh + at, mask=at < size, other=0.0) * _SH_C0 + 0.5
    tl.store(colors + at, tl.where(value < 0, 0.0, value), mask=at < size)


@no_type_check
@triton.jit
def _constant_backward(colors, by_colors, result, size, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    bright = tl.load(colors + at, mask=at < size, other=0.0) > 0
    tl.store(
        result + at, tl.where(bright, tl.load(by_colors + at, mask=at < size, other=0.0) * _SH_C0, 0.0), mask=at < size
    )


@no_type_check
@triton.jit
def _directions(means, viewmat, directions, n, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    for i in tl.static_range(3):
        position = -tl.load(viewmat + i) * tl.load(viewmat + 3)
        position -= tl.load(viewmat + 4 + i) * tl.load(viewmat + 7)
        position -= tl.load(viewmat + 8 + i) * tl.load(viewmat + 11)
        tl.store(
            directions + 3 * row + i, tl.load(means + 3 * row + i, mask=row < n, other=0.0) - position, mask=row < n
        )


@no_type_check
@triton.jit
def _camera_backward(viewmat, total, result):
    """The derivative by `viewmat` of directions whose derivatives add up to `total`."""
    row, column = tl.arange(0, 4)[:, None], tl.arange(0, 4)[None, :]
    turn = (row < 3) & (column < 3)
    by_turn = tl.load(viewmat + 4 * row + 3, mask=row < 3, other=0.0) * tl.load(
        total + column, mask=column < 3, other=0.0
    )
    by_shift = tl.load(viewmat + 4 * row + column, mask=turn, other=0.0) * tl.load(
        total + column, mask=column < 3, other=0.0
    )
    shift = tl.where((row < 3) & (column == 3), tl.sum(by_shift, 1)[:, None], 0.0)
    tl.store(result + 4 * row + column, tl.where(turn, by_turn, shift))


@no_type_check
@triton.jit
def _three_sigma(conics, means2d, opacities, boxes, radii, n, width, height, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    xx, xy = tl.load(conics + 3 * row, mask=there, other=1.0), tl.load(conics + 3 * row + 1, mask=there, other=0.0)
    yy = tl.load(conics + 3 * row + 2, mask=there, other=1.0)
    # The eigenvalue of the inverse covariance.
    smallest = 0.5 * (xx + yy) - tl.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
    reach = tl.ceil(3 / tl.sqrt(tl.maximum(smallest, 1e-12)))
    level = tl.log(tl.load(opacities + row, mask=there, other=1.0) / _MIN_ALPHA)
    level = 2 * tl.maximum(level, 0.0) / (xx * yy - xy * xy)
    across, down = tl.sqrt(level * yy), tl.sqrt(level * xx)
    x, y = tl.load(means2d + 2 * row, mask=there, other=0.0), tl.load(means2d + 2 * row + 1, mask=there, other=0.0)
    drawn = (tl.load(boxes + 2 * row, mask=there, other=0) > 0) & (
        tl.load(boxes + 2 * row + 1, mask=there, other=0) > 0
    )
    drawn = drawn & (x + across > 0) & (y + down > 0) & (x - across < width) & (y - down < height)
    tl.store(radii + row, tl.where(drawn, reach, 0.0).to(tl.int32), mask=there)
