"""Changes of Gaussians with the face, in kernels for a GPU: two launches forward and two backward."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.adam import FactoredTerm
from mien.avatar.ops.changed_gaussians import BASES, FEATURES, PENALTIES, Changes
from mien.kernels import blocks, launch

_BLOCK = 16
_SLOPE = tl.constexpr(0.01)
_OUTPUTS = 4


def changed(
    store: Any, sh: Tensor, changes: Changes
) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:  # fmt: skip
    """Centres, raw opacities and constant coefficients [n, 1, 3] with their changes, and what changed, by name.

    The last are the changes and their weighted mean squares, as `pose_changed_gaussians` returns them.
    """
    bases = [store[name] if name in changes.bases else None for name in BASES]
    layers, neutral, features = changes.layers, None, None
    if layers is not None:
        neutral, features = store["neutral_features"], store["feature_bases"]
    weights = (None, None) if layers is None else (layers.weight1, layers.weight2)
    given = (store["means"], store["opacity_logits"], sh, *bases, neutral, features, *weights)
    means, logits, constant, *values = _Changed.apply(changes, store["face_index"], *given)
    named = zip((*BASES, *FEATURES, *PENALTIES), values, strict=True)
    return means, logits, constant, {name: value for name, value in named if value is not None}


class _Changed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, changes: Changes, rows: Tensor, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        arrays = [None if one is None else one.detach().contiguous() for one in given]
        means, logits, sh, offset, color, opacity, neutral, features, weight1, _ = arrays
        assert means is not None
        assert logits is not None
        n, empty = len(means), means.new_empty
        linear = [None if one is None else empty(one.shape[:-1]) for one in (offset, color, opacity)]
        by_features = [None, None] if neutral is None else [empty(n, 3), empty(n)]
        joined = [empty(n, 3), empty(n), empty(n, 1, 3)]
        programs = blocks(n, _BLOCK)
        sums = empty(2, programs)
        activations = changes.activations.contiguous()
        sizes = {
            "LINEAR": next((one.shape[-1] for one in (offset, color, opacity) if one is not None), 0),
            "COUNT": activations.shape[1], "FEATURES": 0 if neutral is None else neutral.shape[1],
            "HIDDEN": 0 if weight1 is None else len(weight1), "WIDTH": 1 if sh is None else sh.shape[1],
            "BLOCK": _BLOCK,
        }  # fmt: skip
        parts = (rows.contiguous(), activations, *arrays)
        launch(_change, programs, *parts, *joined, *linear, *by_features, sums, n, programs, *changes.weights, **sizes)
        totals = sums.sum(1)
        ctx.changes, ctx.sizes, ctx.neutral = changes, sizes, given[6]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parts, *linear, *by_features)
        any_linear = any(one is not None for one in linear)
        penalties = (totals[0] if any_linear else None, None if neutral is None else totals[1])
        return *joined, *linear, *by_features, *penalties

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        rows, activations, *arrays = ctx.saved_tensors[:12]
        values, changes, sizes = ctx.saved_tensors[12:], ctx.changes, ctx.sizes
        n, programs = len(arrays[0]), blocks(len(arrays[0]), _BLOCK)
        offset, color, opacity, neutral, _, weight1, weight2 = arrays[3:]
        by = [None if one is None else one.contiguous() for one in gradients]
        of_bases = [None if one is None else torch.empty_like(one) for one in (offset, color, opacity)]
        of_features = of_weights = None
        if neutral is not None:
            of_features = torch.empty_like(neutral)
            of_weights = neutral.new_empty(programs, weight1.numel() + weight2.numel())
        launch(
            _change_backward, programs, rows, activations, *arrays[3:], *values, *by, *of_bases, of_features,
            of_weights, n, *changes.weights, **{name: size for name, size in sizes.items() if name != "WIDTH"},
        )  # fmt: skip
        of_sh = by[2]
        if of_sh is not None and sizes["WIDTH"] > 1:
            of_sh = torch.nn.functional.pad(of_sh, (0, 0, 0, sizes["WIDTH"] - 1))
        if of_features is None:
            return None, None, by[0], by[1], of_sh, *of_bases, None, None, None, None
        assert of_weights is not None
        total = of_weights.sum(0)
        if ctx.neutral.is_leaf and ctx.neutral.grad is not None:
            # It may share the memory of an earlier term, and autograd adds to it in place.
            ctx.neutral.grad = ctx.neutral.grad.clone()
        changes.gradient.terms.append(FactoredTerm(of_features.detach(), changes.activations, rows))
        layers = total[: weight1.numel()].view_as(weight1), total[weight1.numel() :].view_as(weight2)
        return None, None, by[0], by[1], of_sh, *of_bases, of_features, None, *layers


@no_type_check
@triton.jit
def _linear(basis, activations, row, triangle, there, part, parts, LINEAR: tl.constexpr, COUNT: tl.constexpr):
    """One number of a linear change of each Gaussian in a block."""
    value = tl.load(activations + triangle * COUNT, mask=there, other=0.0) * 0.0
    for i in tl.static_range(LINEAR):
        own = tl.load(activations + triangle * COUNT + i, mask=there, other=0.0)
        value += own * tl.load(basis + (row * parts + part) * LINEAR + i, mask=there, other=0.0)
    return value


@no_type_check
@triton.jit
def _hidden(
    activations, neutral, features, weight1, row, triangle, there, COUNT: tl.constexpr, FEATURES: tl.constexpr,
    HIDDEN: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr,
):  # fmt: skip
    """Blended features of a block, weights of the first layer, and its values before the activation."""
    number, unit = tl.arange(0, WIDE), tl.arange(0, HIGH)
    known = there[:, None] & (number < FEATURES)[None, :]
    blended = tl.load(neutral + row[:, None] * FEATURES + number[None, :], mask=known, other=0.0)
    for i in range(COUNT):
        own = tl.load(activations + triangle * COUNT + i, mask=there, other=0.0)
        at = (row[:, None].to(tl.int64) * COUNT + i) * FEATURES + number[None, :]
        blended += own[:, None] * tl.load(features + at, mask=known, other=0.0)
    inside = (unit < HIDDEN)[:, None] & (number < FEATURES)[None, :]
    weights = tl.load(weight1 + unit[:, None] * FEATURES + number[None, :], mask=inside, other=0.0)
    return blended, weights, tl.sum(blended[:, None, :] * weights[None, :, :], 2)


@no_type_check
@triton.jit
def _add(values, at, there, change):
    return tl.load(values + at, mask=there, other=0.0) + change


@no_type_check
@triton.jit
def _change(
    rows, activations, means, logits, sh, offset, color, opacity, neutral, features, weight1, weight2, new_means,
    new_logits, new_sh, by_offset, by_color, by_opacity, feature_color, feature_opacity, sums, n, programs, of_linear,
    of_features, LINEAR: tl.constexpr, COUNT: tl.constexpr, FEATURES: tl.constexpr, HIDDEN: tl.constexpr,
    WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    triangle = tl.load(rows + row, mask=there, other=0)
    zero = tl.zeros([BLOCK], means.dtype.element_ty)
    linear, by_network, raised = zero, zero, zero
    if FEATURES > 0:
        WIDE: tl.constexpr = triton.next_power_of_2(FEATURES)
        HIGH: tl.constexpr = triton.next_power_of_2(HIDDEN)
        _, _, hidden = _hidden(
            activations, neutral, features, weight1, row, triangle, there, COUNT, FEATURES, HIDDEN, WIDE, HIGH
        )
        hidden, unit = tl.where(hidden < 0, hidden * _SLOPE, hidden), tl.arange(0, HIGH)
        last = tl.load(weight2 + 3 * HIDDEN + unit, mask=unit < HIDDEN, other=0.0)
        own = tl.sum(hidden * last[None, :], 1)
        tl.store(feature_opacity + row, own, mask=there)
        by_network += tl.where(there, own * own / n, 0.0)
        raised += own
    if opacity is not None:
        own = _linear(opacity, activations, row, triangle, there, 0, 1, LINEAR, COUNT)
        tl.store(by_opacity + row, own, mask=there)
        linear += tl.where(there, own * own / n, 0.0)
        raised += own
    tl.store(new_logits + row, _add(logits, row, there, raised), mask=there)
    for i in tl.static_range(3):
        moved, colored, at = zero, zero, 3 * row + i
        if offset is not None:
            moved = _linear(offset, activations, row, triangle, there, i, 3, LINEAR, COUNT)
            tl.store(by_offset + at, moved, mask=there)
            linear += tl.where(there, moved * moved / (3 * n), 0.0)
        tl.store(new_means + at, _add(means, at, there, moved), mask=there)
        if color is not None:
            own = _linear(color, activations, row, triangle, there, i, 3, LINEAR, COUNT)
            tl.store(by_color + at, own, mask=there)
            linear += tl.where(there, own * own / (3 * n), 0.0)
            colored += own
        if FEATURES > 0:
            own = tl.sum(hidden * tl.load(weight2 + i * HIDDEN + unit, mask=unit < HIDDEN, other=0.0)[None, :], 1)
            tl.store(feature_color + at, own, mask=there)
            by_network += tl.where(there, own * own / (3 * n), 0.0)
            colored += own
        tl.store(new_sh + at, _add(sh, 3 * WIDTH * row + i, there, colored), mask=there)
    tl.store(sums + tl.program_id(0), of_linear * tl.sum(linear, 0))
    tl.store(sums + programs + tl.program_id(0), of_features * tl.sum(by_network, 0))


@no_type_check
@triton.jit
def _optional(values, at, there, factor):
    result = factor * 0.0
    if values is not None:
        result += factor * tl.load(values + at, mask=there, other=0.0)
    return result


@no_type_check
@triton.jit
def _by_change(by_joined, by_own, by_penalty, value, at, there, scale):
    """The derivative by a change: through the value that it joins, by itself, and through its mean square."""
    known = tl.load(value + at, mask=there, other=0.0)
    result = _optional(by_joined, at, there, known * 0.0 + 1.0) + _optional(by_own, at, there, known * 0.0 + 1.0)
    if by_penalty is not None:
        result += tl.load(by_penalty) * 2 * scale * known
    return result


@no_type_check
@triton.jit
def _to_basis(
    result, activations, row, triangle, there, gradient, part, parts, LINEAR: tl.constexpr, COUNT: tl.constexpr
):
    for i in tl.static_range(LINEAR):
        own = gradient * tl.load(activations + triangle * COUNT + i, mask=there, other=0.0)
        tl.store(result + (row * parts + part) * LINEAR + i, own, mask=there)


@no_type_check
@triton.jit
def _change_backward(
    rows, activations, offset, color, opacity, neutral, features, weight1, weight2, by_offset, by_color, by_opacity,
    feature_color, feature_opacity, of_means, of_logits, of_sh, of_offset, of_color, of_opacity, of_network_color,
    of_network_opacity, of_linear, of_features, to_offset, to_color, to_opacity, to_features, to_weights, n,
    linear_weight, feature_weight, LINEAR: tl.constexpr, COUNT: tl.constexpr, FEATURES: tl.constexpr,
    HIDDEN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    triangle = tl.load(rows + row, mask=there, other=0)
    if opacity is not None:
        own = _by_change(of_logits, of_opacity, of_linear, by_opacity, row, there, linear_weight / n)
        _to_basis(to_opacity, activations, row, triangle, there, own, 0, 1, LINEAR, COUNT)
    for i in tl.static_range(3):
        at, share = 3 * row + i, linear_weight / (3 * n)
        if offset is not None:
            own = _by_change(of_means, of_offset, of_linear, by_offset, at, there, share)
            _to_basis(to_offset, activations, row, triangle, there, own, i, 3, LINEAR, COUNT)
        if color is not None:
            own = _by_change(of_sh, of_color, of_linear, by_color, at, there, share)
            _to_basis(to_color, activations, row, triangle, there, own, i, 3, LINEAR, COUNT)
    if FEATURES > 0:
        WIDE: tl.constexpr = triton.next_power_of_2(FEATURES)
        HIGH: tl.constexpr = triton.next_power_of_2(HIDDEN)
        blended, weights, before = _hidden(
            activations, neutral, features, weight1, row, triangle, there, COUNT, FEATURES, HIDDEN, WIDE, HIGH
        )
        hidden, unit, number = tl.where(before < 0, before * _SLOPE, before), tl.arange(0, HIGH), tl.arange(0, WIDE)
        by_hidden, start = hidden * 0.0, to_weights + tl.program_id(0) * (HIDDEN * FEATURES + 4 * HIDDEN)
        for i in tl.static_range(4):
            if i == 3:
                own = _by_change(
                    of_logits, of_network_opacity, of_features, feature_opacity, row, there, feature_weight / n
                )
            else:
                at, share = 3 * row + i, feature_weight / (3 * n)
                own = _by_change(of_sh, of_network_color, of_features, feature_color, at, there, share)
            own = tl.where(there, own, 0.0)
            last = tl.load(weight2 + i * HIDDEN + unit, mask=unit < HIDDEN, other=0.0)
            by_hidden += own[:, None] * last[None, :]
            tl.store(start + HIDDEN * (FEATURES + i) + unit, tl.sum(own[:, None] * hidden, 0), mask=unit < HIDDEN)
        by_hidden = tl.where(before > 0, by_hidden, by_hidden * _SLOPE)
        at, known = row[:, None] * FEATURES + number[None, :], there[:, None] & (number < FEATURES)[None, :]
        tl.store(to_features + at, tl.sum(by_hidden[:, :, None] * weights[None, :, :], 1), mask=known)
        inside = (unit < HIDDEN)[:, None] & (number < FEATURES)[None, :]
        by_weights = tl.sum(by_hidden[:, :, None] * blended[:, None, :], 0)
        tl.store(start + unit[:, None] * FEATURES + number[None, :], by_weights, mask=inside)
