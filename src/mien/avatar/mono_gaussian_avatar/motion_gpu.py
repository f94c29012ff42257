"""The motion of free points in kernels for a GPU: bones, skinning, activations, and distances from the face model."""

from typing import Any, NamedTuple, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.avatar.mono_gaussian_avatar.networks import SKINNING_SHARPNESS
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.gaussians import SH_C0
from mien.kernels import blocks, launch

_BLOCK = 128
_FEW = 16
_VERTICES = 256
_UNIT = tl.constexpr(LENGTH_UNIT)
_SH_C0 = tl.constexpr(SH_C0)
_SKINNING_SHARPNESS = tl.constexpr(SKINNING_SHARPNESS)


class Surface(NamedTuple):
    """The surface that points are compared with, the same for all steps."""

    vertices: Tensor
    """The canonical vertices [v, 3]."""
    bases: Tensor
    """Blend directions of the vertices [c, v, 3], of the expression and then of pose features. It may lack the last."""
    weights: Tensor
    """Skinning weights [v, joints]."""
    bones: Tensor
    """The joints that are bones."""
    units: Tensor
    """Factors on differences of the directions of the expression [e]."""


def moved_points(outputs: Tensor, means: Tensor, from_bones: Tensor, to_bones: Tensor) -> tuple[Tensor, Tensor]:
    """Places of points [b, n, 3], and their motion from the canonical places, given outputs of the deformation network.

    One launch forward and two backward. `outputs` are offsets, sums of directions of each timestep, and logits of
    skinning weights.
    """
    return _Moved.apply(outputs, means, from_bones, to_bones)  # pyright: ignore[reportReturnType]


def activated(rest: Tensor, own: Tensor | None, change: Tensor, gain: float, radius: float) -> tuple[Tensor, ...]:
    """Scales, quaternions, opacities and constant coefficients of colours, given raw attributes of rest and changes."""
    return _Activated.apply(rest, own, change, gain, radius)  # pyright: ignore[reportReturnType]


def face_distances(
    outputs: Tensor, means: Tensor, surface: Surface, weights: tuple[float, float, float]
) -> tuple[Tensor, ...]:
    """`FreePoints.face_losses`, given outputs of the whole deformation network: skinning, expression, pose features.

    Three launches forward and one backward.
    """
    return _Distances.apply(outputs, means.detach(), surface, weights)  # pyright: ignore[reportReturnType]


class _Moved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> tuple[Tensor, Tensor]:
        outputs, means, from_bones, to_bones = given = [one.contiguous() for one in arguments]
        ctx.set_materialize_grads(False)
        (b, k), n = to_bones.shape[:2], len(means)
        posed, displacement, weights = means.new_empty(b, n, 3), means.new_empty(b, n, 3), means.new_empty(n, k)
        ctx.constants = {"BONES": triton.next_power_of_2(k), "BLOCK": _BLOCK}
        sizes = (n, k, b, outputs.shape[1])
        launch(_move, blocks(n, _BLOCK), *given, posed, displacement, weights, *sizes, **ctx.constants)
        ctx.sizes = sizes
        ctx.save_for_backward(outputs, means, from_bones, to_bones, weights)
        return posed, displacement

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_posed: Tensor | None, by_displacement: Tensor | None) -> tuple[Tensor | None, ...]:
        outputs, means, from_bones, to_bones, weights = ctx.saved_tensors
        n, k, b, _ = ctx.sizes
        by_posed, by_displacement = (None if one is None else one.contiguous() for one in (by_posed, by_displacement))
        by_outputs, by_means, outer = torch.empty_like(outputs), torch.empty_like(means), means.new_empty(b, n, 12)
        launch(
            _move_backward, blocks(n, _BLOCK), by_posed, by_displacement, *ctx.saved_tensors, by_outputs, by_means,
            outer, *ctx.sizes, **ctx.constants,
        )  # fmt: skip
        by_bones = torch.matmul(weights.T, outer).view(b, k, 3, 4)
        return by_outputs, by_means, None, by_bones


class _Activated(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rest: Tensor, own: Tensor | None, change: Tensor, gain: float, radius: float
    ) -> tuple[Tensor, ...]:
        raw = (rest.contiguous(), None if own is None else own.detach().contiguous(), change.contiguous())
        b, n = change.shape[:2]
        results = tuple(change.new_empty(b, n, *shape) for shape in ((3,), (4,), (), (1, 3)))
        ctx.save_for_backward(*raw)
        ctx.sizes = (n, b, gain, radius)
        launch(_activate, blocks(n, _BLOCK), *raw, *results, *ctx.sizes, BLOCK=_BLOCK)
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rest, own, change = ctx.saved_tensors
        by_rest, by_change = torch.empty_like(rest), torch.empty_like(change)
        given = (*(one.contiguous() for one in gradients), by_rest, by_change)
        launch(_activate_backward, blocks(len(rest), _BLOCK), rest, own, change, *given, *ctx.sizes, BLOCK=_BLOCK)
        return by_rest, None if own is None else by_rest, by_change, None, None


class _Distances(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, outputs: Tensor, means: Tensor, surface: Surface, weights: tuple[float, float, float]
    ) -> tuple[Tensor, ...]:
        outputs, n, v = outputs.contiguous(), len(means), len(surface.vertices)
        bones, e = len(surface.bones), len(surface.units)
        c = (outputs.shape[1] - bones - 1) // 3 - 1
        nearest = torch.empty(n, dtype=torch.int64, device=means.device)
        points = (means.contiguous(), outputs, surface.vertices, nearest, n, v, outputs.shape[1])
        launch(_nearest, blocks(n, _FEW), *points, c, BLOCK=_FEW, VERTICES=_VERTICES)
        counts = (n * (bones + 1), n * 3 * e, n * 3 * (c - e))
        shares = tuple(weight / max(count, 1) for weight, count in zip(weights, counts, strict=True))
        sizes = (n, v, c, e, len(surface.bases), bones, surface.weights.shape[1], *shares)
        lanes = {"DIRECTIONS": triton.next_power_of_2(c + 1), "BONES": triton.next_power_of_2(bones + 1)}
        sums = means.new_empty(3, n)
        ctx.arguments = (surface.bases, surface.weights, surface.bones, surface.units)
        launch(_distance, n, outputs, nearest, *ctx.arguments, sums, *sizes, **lanes)
        ctx.sizes, ctx.lanes = sizes, lanes
        ctx.save_for_backward(outputs, nearest)
        return sums.sum(1).unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        outputs, nearest = ctx.saved_tensors
        result = torch.empty_like(outputs)
        given = (outputs, nearest, *ctx.arguments, *gradients, result)
        launch(_distance_backward, len(outputs), *given, *ctx.sizes, **ctx.lanes)
        return result, None, None, None


@no_type_check
@triton.jit
def _blended(weights, bones, entry, k, BONES: tl.constexpr):
    """A number of each point's transform, the mean of the bones' weighted by its skinning weights."""
    bone = tl.arange(0, BONES)
    return tl.sum(weights * tl.load(bones + 12 * bone + entry, mask=bone < k, other=0.0)[None, :], 1)


@no_type_check
@triton.jit
def _blended_row(weights, bones, first, k, BONES: tl.constexpr):
    one, two = _blended(weights, bones, first, k, BONES), _blended(weights, bones, first + 1, k, BONES)
    return one, two, _blended(weights, bones, first + 2, k, BONES), _blended(weights, bones, first + 3, k, BONES)


@no_type_check
@triton.jit
def _rested(weights, bones, k, x, y, z, BONES: tl.constexpr):
    """Places of points before transforms moved them (Cramer's rule), and the inverse of the transforms, by columns."""
    a0, a1, a2, a3 = _blended_row(weights, bones, 0, k, BONES)
    b0, b1, b2, b3 = _blended_row(weights, bones, 4, k, BONES)
    c0, c1, c2, c3 = _blended_row(weights, bones, 8, k, BONES)
    i0, i1, i2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    j0, j1, j2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
    k0, k1, k2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    one = 1 / (a0 * i0 + a1 * i1 + a2 * i2)
    x, y, z = (x - a3) * one, (y - b3) * one, (z - c3) * one
    places = i0 * x + j0 * y + k0 * z, i1 * x + j1 * y + k1 * z, i2 * x + j2 * y + k2 * z
    return places, (i0 * one, i1 * one, i2 * one), (j0 * one, j1 * one, j2 * one), (k0 * one, k1 * one, k2 * one)


@no_type_check
@triton.jit
def _softmax(logits):
    raised = tl.exp(logits - tl.max(tl.where(logits == logits, logits, 0.0), 1)[:, None])
    return raised / tl.sum(raised, 1)[:, None]


@no_type_check
@triton.jit
def _vector(tensor, at, there):
    return (
        tl.load(tensor + at, mask=there, other=0.0), tl.load(tensor + at + 1, mask=there, other=0.0),
        tl.load(tensor + at + 2, mask=there, other=0.0),
    )  # fmt: skip


@no_type_check
@triton.jit
def _store(tensor, at, there, x, y, z):
    tl.store(tensor + at, x, mask=there)
    tl.store(tensor + at + 1, y, mask=there)
    tl.store(tensor + at + 2, z, mask=there)


@no_type_check
@triton.jit
def _move(
    outputs, means, from_bones, to_bones, posed, displacement, weights, n, k, b, width, BONES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    row, bone = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, BONES)
    there, known = row < n, (row < n)[:, None] & (bone < k)[None, :]
    wide = row.to(tl.int64)
    logits = tl.load(outputs + (wide * width + 3 + 3 * b)[:, None] + bone[None, :], mask=known, other=0.0)
    own = _softmax(tl.where((bone < k)[None, :], logits * _SKINNING_SHARPNESS, float("-inf")))
    tl.store(weights + wide[:, None] * k + bone[None, :], own, mask=known)
    x, y, z = _vector(means, 3 * wide, there)
    to_x, to_y, to_z = _vector(outputs, wide * width, there)
    x, y, z = x + to_x * _UNIT, y + to_y * _UNIT, z + to_z * _UNIT
    rest, _, _, _ = _rested(own, from_bones, k, x, y, z, BONES)
    for timestep in range(b):
        to_x, to_y, to_z = _vector(outputs, wide * width + 3 + 3 * timestep, there)
        shaped = rest[0] + to_x * _UNIT, rest[1] + to_y * _UNIT, rest[2] + to_z * _UNIT
        bones, at, place = to_bones + 12 * k * timestep, 3 * (timestep * n + wide), (x, y, z)
        for i in tl.static_range(3):
            moved = _blended(own, bones, 4 * i + 3, k, BONES)
            for j in tl.static_range(3):
                moved += _blended(own, bones, 4 * i + j, k, BONES) * shaped[j]
            tl.store(posed + at + i, moved, mask=there)
            tl.store(displacement + at + i, moved - place[i], mask=there)


@no_type_check
@triton.jit
def _add_to_weights(total, bones, i: tl.constexpr, gradient, places, k, BONES: tl.constexpr):
    """Add derivatives by skinning weights, given those by a coordinate of where the transforms put places."""
    bone = tl.arange(0, BONES)
    total += gradient[:, None] * tl.load(bones + 12 * bone + 4 * i + 3, mask=bone < k, other=0.0)[None, :]
    for j in tl.static_range(3):
        entry = tl.load(bones + 12 * bone + 4 * i + j, mask=bone < k, other=0.0)
        total += (gradient * places[j])[:, None] * entry[None, :]
    return total


@no_type_check
@triton.jit
def _move_backward(
    by_posed, by_displacement, outputs, means, from_bones, to_bones, weights, by_outputs, by_means, outer, n, k, b,
    width, BONES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    row, bone = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, BONES)
    there, known = row < n, (row < n)[:, None] & (bone < k)[None, :]
    wide = row.to(tl.int64)
    own = tl.load(weights + wide[:, None] * k + bone[None, :], mask=known, other=0.0)
    own = tl.where((row >= n)[:, None] & (bone == 0)[None, :], 1.0, own)  # Lanes beyond the last point divide, too.
    x, y, z = _vector(means, 3 * wide, there)
    to_x, to_y, to_z = _vector(outputs, wide * width, there)
    rest, left, middle, right = _rested(
        own, from_bones, k, x + to_x * _UNIT, y + to_y * _UNIT, z + to_z * _UNIT, BONES
    )  # fmt: skip
    by_own = own * 0.0
    by_x, by_y, by_z = x * 0.0, x * 0.0, x * 0.0
    rest_x, rest_y, rest_z = x * 0.0, x * 0.0, x * 0.0
    for timestep in range(b):
        to_x, to_y, to_z = _vector(outputs, wide * width + 3 + 3 * timestep, there)
        shaped = rest[0] + to_x * _UNIT, rest[1] + to_y * _UNIT, rest[2] + to_z * _UNIT
        bones, at = to_bones + 12 * k * timestep, timestep * n + wide
        given_x, given_y, given_z = x * 0.0, x * 0.0, x * 0.0
        if by_posed is not None:
            given_x, given_y, given_z = _vector(by_posed, 3 * at, there)
        if by_displacement is not None:
            more_x, more_y, more_z = _vector(by_displacement, 3 * at, there)
            given_x, given_y, given_z = given_x + more_x, given_y + more_y, given_z + more_z
            by_x, by_y, by_z = by_x - more_x, by_y - more_y, by_z - more_z
        given = given_x, given_y, given_z
        for i in tl.static_range(3):
            by_own = _add_to_weights(by_own, bones, i, given[i], shaped, k, BONES)
            tl.store(outer + 12 * at + 4 * i + 3, given[i], mask=there)
        for j in tl.static_range(3):
            by_shaped = x * 0.0
            for i in tl.static_range(3):
                by_shaped += _blended(own, bones, 4 * i + j, k, BONES) * given[i]
                tl.store(outer + 12 * at + 4 * i + j, given[i] * shaped[j], mask=there)
            tl.store(by_outputs + wide * width + 3 + 3 * timestep + j, by_shaped * _UNIT, mask=there)
            if j == 0:
                rest_x += by_shaped
            elif j == 1:
                rest_y += by_shaped
            else:
                rest_z += by_shaped
    through = (
        left[0] * rest_x + left[1] * rest_y + left[2] * rest_z,
        middle[0] * rest_x + middle[1] * rest_y + middle[2] * rest_z,
        right[0] * rest_x + right[1] * rest_y + right[2] * rest_z,
    )
    for i in tl.static_range(3):
        by_own = _add_to_weights(by_own, from_bones, i, -through[i], rest, k, BONES)
    by_x, by_y, by_z = by_x + through[0], by_y + through[1], by_z + through[2]
    _store(by_means, 3 * wide, there, by_x, by_y, by_z)
    _store(by_outputs, wide * width, there, by_x * _UNIT, by_y * _UNIT, by_z * _UNIT)
    by_logits = own * (by_own - tl.sum(own * by_own, 1)[:, None]) * _SKINNING_SHARPNESS
    tl.store(by_outputs + (wide * width + 3 + 3 * b)[:, None] + bone[None, :], by_logits, mask=known)


@no_type_check
@triton.jit
def _raw(rest, own, change, row, timestep, n, there):
    column = tl.arange(0, 16)
    at, known = row[:, None] * 11 + column[None, :], there[:, None] & (column < 11)[None, :]
    raw = tl.load(rest + at, mask=known, other=0.0)
    if own is not None:
        raw += tl.load(own + at, mask=known, other=0.0)
    return raw + tl.load(change + timestep * 11 * n + at, mask=known, other=0.0)


@no_type_check
@triton.jit
def _lengths(raw):
    """The length of the four numbers of a quaternion, as `torch.nn.functional.normalize` has it."""
    column = tl.arange(0, 16)[None, :]
    squares = tl.where((column >= 3) & (column < 7), raw * raw, 0.0)
    length = tl.sqrt(tl.sum(squares, 1))
    return tl.where(length < 1e-12, 1e-12, length)[:, None]


@no_type_check
@triton.jit
def _sigmoid(values):
    raised = tl.exp(tl.where(values < 0, values, -values))
    return tl.where(values < 0, raised, 1.0) / (1 + raised)


@no_type_check
@triton.jit
def _activate(
    rest, own, change, scales, quats, opacities, sh, n, b, gain, radius, BLOCK: tl.constexpr
):  # fmt: skip
    row, column = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64), tl.arange(0, 16)[None, :]
    there, known = row < n, (row < n)[:, None]
    for timestep in range(b):
        raw, at = _raw(rest, own, change, row, timestep, n, there), (timestep * n + row)[:, None]
        share = _sigmoid(raw)
        tl.store(scales + 3 * at + column, gain * share + radius, mask=known & (column < 3))
        tl.store(quats + 4 * at + column - 3, raw / _lengths(raw), mask=known & (column >= 3) & (column < 7))
        tl.store(opacities + at + column - 7, share, mask=known & (column == 7))
        tl.store(sh + 3 * at + column - 8, (share - 0.5) / _SH_C0, mask=known & (column >= 8) & (column < 11))


@no_type_check
@triton.jit
def _activate_backward(
    rest, own, change, by_scales, by_quats, by_opacities, by_sh, by_rest, by_change, n, b, gain, radius,
    BLOCK: tl.constexpr,
):  # fmt: skip
    row, column = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64), tl.arange(0, 16)[None, :]
    there, known = row < n, (row < n)[:, None]
    total = tl.zeros([BLOCK, 16], by_rest.dtype.element_ty)
    for timestep in range(b):
        raw, at = _raw(rest, own, change, row, timestep, n, there), (timestep * n + row)[:, None]
        share, length = _sigmoid(raw), _lengths(raw)
        by_quat = tl.load(by_quats + 4 * at + column - 3, mask=known & (column >= 3) & (column < 7), other=0.0)
        along = tl.where(length > 1e-12, tl.sum(by_quat * raw, 1)[:, None] / length / length, 0.0)
        gradient = gain * tl.load(by_scales + 3 * at + column, mask=known & (column < 3), other=0.0)
        gradient += tl.load(by_opacities + at + column - 7, mask=known & (column == 7), other=0.0)
        colors = known & (column >= 8) & (column < 11)
        gradient += tl.load(by_sh + 3 * at + column - 8, mask=colors, other=0.0) / _SH_C0
        turned = (column >= 3) & (column < 7)
        gradient = tl.where(turned, (by_quat - raw * along) / length, gradient * share * (1 - share))
        tl.store(by_change + 11 * at + column, gradient, mask=known & (column < 11))
        total += gradient
    tl.store(by_rest + 11 * row[:, None] + column, total, mask=known & (column < 11))


@no_type_check
@triton.jit
def _nearest(points, outputs, vertices, result, n, v, width, c, BLOCK: tl.constexpr, VERTICES: tl.constexpr):
    """`outputs` have offsets of the points, each the first of 1 + c directions."""
    row, vertex = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, VERTICES)
    there = row < n
    x, y, z = _vector(points, 3 * row, there)
    x += tl.load(outputs + row * width, mask=there, other=0.0) * _UNIT
    y += tl.load(outputs + row * width + 1 + c, mask=there, other=0.0) * _UNIT
    z += tl.load(outputs + row * width + 2 + 2 * c, mask=there, other=0.0) * _UNIT
    least, found = x * 0.0 + float("inf"), row * 0
    for first in range(0, v, VERTICES):
        at = first + vertex
        to_x, to_y, to_z = _vector(vertices, 3 * at, at < v)
        across, down, deep = x[:, None] - to_x[None, :], y[:, None] - to_y[None, :], z[:, None] - to_z[None, :]
        squares = across * across + down * down + deep * deep
        squares = tl.where((at < v)[None, :] & (squares == squares), squares, float("inf"))
        lowest = tl.min(squares, 1)
        own = first + tl.argmin(squares, 1)
        nearer = lowest < least
        least, found = tl.where(nearer, lowest, least), tl.where(nearer, own, found)
    tl.store(result + row, found.to(tl.int64), mask=there)


@no_type_check
@triton.jit
def _own_weights(outputs, row, weights, bones, vertex, c, count, joints, BONES: tl.constexpr):
    """A point's skinning weights, and how they differ from those of a vertex. The last bone belongs to none."""
    bone = tl.arange(0, BONES)
    logits = tl.load(outputs + row + 3 * (1 + c) + bone, mask=bone <= count, other=0.0) * _SKINNING_SHARPNESS
    own = _softmax(tl.where(bone <= count, logits, float("-inf"))[None, :])
    joint = tl.load(bones + bone, mask=bone < count, other=0)
    return own, own - tl.load(weights + vertex * joints + joint, mask=bone < count, other=0.0)[None, :]


@no_type_check
@triton.jit
def _difference(outputs, row, bases, units, vertex, axis, v, c, e, known, DIRECTIONS: tl.constexpr):
    """How one coordinate of a point's directions differs from that of a vertex, in units of the losses."""
    direction = tl.arange(0, DIRECTIONS)
    own = tl.load(outputs + row + axis * (1 + c) + 1 + direction, mask=direction < c, other=0.0)
    other = tl.load(bases + (direction.to(tl.int64) * v + vertex) * 3 + axis, mask=direction < known, other=0.0)
    unit = tl.load(units + direction, mask=direction < e, other=1.0)
    return tl.where(direction < c, own - other / _UNIT, 0.0) * unit, unit


@no_type_check
@triton.jit
def _distance(
    outputs, nearest, bases, weights, bones, units, sums, n, v, c, e, known, count, joints, of_weights, of_expression,
    of_pose, DIRECTIONS: tl.constexpr, BONES: tl.constexpr,
):  # fmt: skip
    """A program is a point."""
    point, direction = tl.program_id(0), tl.arange(0, DIRECTIONS)
    row, vertex = point.to(tl.int64) * (3 * (1 + c) + count + 1), tl.load(nearest + point)
    _, difference = _own_weights(outputs, row, weights, bones, vertex, c, count, joints, BONES)
    tl.store(sums + point, of_weights * tl.sum(tl.sum(difference * difference, 1), 0))
    squares = tl.zeros([DIRECTIONS], sums.dtype.element_ty)
    for axis in tl.static_range(3):
        difference, _ = _difference(outputs, row, bases, units, vertex, axis, v, c, e, known, DIRECTIONS)
        squares += difference * difference
    tl.store(sums + n + point, of_expression * tl.sum(tl.where(direction < e, squares, 0.0), 0))
    tl.store(sums + 2 * n + point, of_pose * tl.sum(tl.where(direction < e, 0.0, squares), 0))


@no_type_check
@triton.jit
def _distance_backward(
    outputs, nearest, bases, weights, bones, units, by_weights, by_expression, by_pose, result, n, v, c, e, known,
    count, joints, of_weights, of_expression, of_pose, DIRECTIONS: tl.constexpr, BONES: tl.constexpr,
):  # fmt: skip
    point, direction, bone = tl.program_id(0), tl.arange(0, DIRECTIONS), tl.arange(0, BONES)
    row, vertex = point.to(tl.int64) * (3 * (1 + c) + count + 1), tl.load(nearest + point)
    own, difference = _own_weights(outputs, row, weights, bones, vertex, c, count, joints, BONES)
    gradient = tl.load(by_weights) * 2 * of_weights * difference
    gradient = own * (gradient - tl.sum(own * gradient, 1)[:, None]) * _SKINNING_SHARPNESS
    tl.store(result + row + 3 * (1 + c) + bone[None, :], gradient, mask=(bone <= count)[None, :])
    expression, pose = tl.load(by_expression) * 2 * of_expression, tl.load(by_pose) * 2 * of_pose
    for axis in tl.static_range(3):
        difference, unit = _difference(outputs, row, bases, units, vertex, axis, v, c, e, known, DIRECTIONS)
        gradient = difference * unit * tl.where(direction < e, expression, pose)
        tl.store(result + row + axis * (1 + c) + 1 + direction, gradient, mask=direction < c)
        tl.store(result + row + axis * (1 + c) + direction, gradient * 0.0, mask=direction == 0)
