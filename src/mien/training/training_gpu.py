"""Small parts of a training step in kernels for a GPU: statistics, hidden Gaussians, updates of factored tensors."""

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.adam import BETA2, EPSILON, FactoredMoments, FactoredTerm
from mien.kernels import blocks, launch

_BLOCK = 256
_BETA2 = tl.constexpr(BETA2)
_EPSILON = tl.constexpr(EPSILON)


def observe_view(
    gradient: Tensor, radii: Tensor, opacities: Tensor, scale: tuple[float, float], *statistics: Tensor
) -> None:
    """`mien.training.density_control.gradient.observe_reference` in one launch."""
    given = (gradient.contiguous(), radii, opacities.contiguous(), *statistics)
    launch(_observe, blocks(len(radii), _BLOCK), *given, len(radii), *scale, BLOCK=_BLOCK)


def factored_update(values: Tensor, terms: Sequence[FactoredTerm], moments: FactoredMoments, rate: float) -> None:
    """`mien.training.adam.factored_update` with `FactoredMoments` in one launch, which never makes the gradient."""
    n, k, f = values.shape
    given = tuple((rows, columns, places) for rows, columns, places in map(_contiguous, terms))
    rows, columns, places = (tuple(own) for own in zip(*given, strict=True))
    launch(
        _update_factored, n, values.detach(), rows, columns, places, moments.second, moments.weights, rate, k, f,
        COLUMNS=triton.next_power_of_2(k), WIDTH=triton.next_power_of_2(f),
    )  # fmt: skip


def _contiguous(term: FactoredTerm) -> tuple[Tensor, Tensor, Tensor | None]:
    places = None if term.places is None else term.places.contiguous()
    return term.rows.contiguous(), torch.atleast_2d(term.columns.detach()).contiguous(), places


def covered(
    sh: Tensor, opacities: Tensor, hidden: Tensor, triangles: Tensor, color: tuple[float, float, float]
) -> tuple[Tensor, Tensor]:
    """`mien.training.whole_head.mouth_interior.covered_reference`, with the triangles of the Gaussians."""
    return _Covered.apply(sh, opacities, hidden, triangles, color)  # pyright: ignore[reportReturnType]


class _Covered(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sh: Tensor, opacities: Tensor, hidden: Tensor, triangles: Tensor, color: tuple[float, float, float]
    ) -> tuple[Tensor, Tensor]:
        given = (sh.contiguous(), hidden.contiguous(), triangles.contiguous())
        result, width = torch.empty_like(given[0]), sh.shape[1] * 3
        launch(_cover, blocks(sh.numel(), _BLOCK), *given, result, sh.numel(), width, *color, BLOCK=_BLOCK)
        ctx.save_for_backward(*given[1:])
        return result, opacities.view_as(opacities)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_sh: Tensor, by_opacities: Tensor) -> tuple[Tensor | None, ...]:
        by_sh, by_opacities, size = by_sh.contiguous(), by_opacities.contiguous(), by_sh.numel()
        results, width = (torch.empty_like(by_sh), torch.empty_like(by_opacities)), by_sh.shape[1] * 3
        programs = blocks(size, _BLOCK)
        launch(_cover_backward, programs, by_sh, by_opacities, *ctx.saved_tensors, *results, size, width, BLOCK=_BLOCK)
        return *results, None, None, None


@no_type_check
@triton.jit
def _observe(gradient, radii, opacities, sums, views, largest, highest, n, across, down, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    x = tl.load(gradient + 2 * row, mask=there, other=0.0) * across
    y = tl.load(gradient + 2 * row + 1, mask=there, other=0.0) * down
    tl.store(sums + row, tl.load(sums + row, mask=there, other=0.0) + tl.sqrt(x * x + y * y), mask=there)
    radius, before = tl.load(radii + row, mask=there, other=0), tl.load(largest + row, mask=there, other=0)
    tl.store(views + row, tl.load(views + row, mask=there, other=0.0) + tl.where(radius > 0, 1.0, 0.0), mask=there)
    tl.store(largest + row, tl.maximum(radius, before), mask=there)
    opacity, known = tl.load(opacities + row, mask=there, other=0.0), tl.load(highest + row, mask=there, other=0.0)
    tl.store(highest + row, tl.where(opacity <= known, known, opacity), mask=there)


@no_type_check
@triton.jit
def _update_factored(
    values, rows, columns, places, second, weights, rate, k, f, COLUMNS: tl.constexpr, WIDTH: tl.constexpr
):
    row = tl.program_id(0).to(tl.int64)
    column, number = tl.arange(0, COLUMNS), tl.arange(0, WIDTH)
    wide, high = number < f, column < k
    gradient = tl.zeros([COLUMNS, WIDTH], values.dtype.element_ty)
    for i in tl.static_range(len(rows)):
        place = 0
        if places[i] is not None:
            place = tl.load(places[i] + row)
        own = tl.load(rows[i] + row * f + number, mask=wide, other=0.0)
        gradient += tl.load(columns[i] + place * k + column, mask=high, other=0.0)[:, None] * own[None, :]
    touched = tl.max(tl.max(tl.where(gradient != 0, 1, 0), 1), 0) > 0
    squares = tl.sum(gradient * gradient, 0) / k
    weight, spread = tl.load(weights + row), tl.load(second + row * f + number, mask=wide, other=0.0)
    new_weight = tl.where(touched, weight * _BETA2 + (1 - _BETA2), weight)
    spread = tl.where(touched, spread * _BETA2 + squares * (1 - _BETA2), spread)
    tl.store(second + row * f + number, spread, mask=wide)
    tl.store(weights + row, new_weight)
    deviation = tl.sqrt(spread / tl.where(touched, new_weight, 1.0)) + _EPSILON
    at, there = row * k * f + column[:, None] * f + number[None, :], high[:, None] & wide[None, :]
    before = tl.load(values + at, mask=there, other=0.0)
    tl.store(values + at, before - rate * gradient / deviation[None, :], mask=there & (gradient != 0))


@no_type_check
@triton.jit
def _cover(sh, hidden, triangles, result, size, width, red, green, blue, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, number = at < size, at % width
    own = tl.load(hidden + tl.load(triangles + at // width, mask=there, other=0), mask=there, other=0) != 0
    color = tl.where(number == 0, red, tl.where(number == 1, green, tl.where(number == 2, blue, 0.0)))
    tl.store(result + at, tl.where(own, color, tl.load(sh + at, mask=there, other=0.0)), mask=there)


@no_type_check
@triton.jit
def _cover_backward(by_sh, by_opacities, hidden, triangles, of_sh, of_opacities, size, width, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, row = at < size, at // width
    own = tl.load(hidden + tl.load(triangles + row, mask=there, other=0), mask=there, other=0) != 0
    tl.store(of_sh + at, tl.where(own, 0.0, tl.load(by_sh + at, mask=there, other=0.0)), mask=there)
    first = there & (at % width == 0)
    opacity = tl.load(by_opacities + row, mask=first, other=0.0)
    tl.store(of_opacities + row, tl.where(own, 0.0, opacity), mask=first)
