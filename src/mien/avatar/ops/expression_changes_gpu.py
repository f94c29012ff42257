"""The activations of a face in kernels for a GPU: two launches. They have no gradient."""

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

from mien.face.params import FaceParams
from mien.face.posing_gpu import rotation_entry
from mien.kernels import launch

_SEEN = 32  # rows of what training saw that are looked at together


def activation_table(buffers: Any, face: FaceParams, margin: float, least: float) -> Tensor:
    """`ExpressionActivations.reference`, given its buffers by name."""
    regions, expressions = buffers.shares.shape[1], face.expression.shape[1]
    inputs, own = len(buffers.rest), buffers.directions.shape[1] // regions
    pose = buffers.head_directions.shape[1]
    table = buffers.rest.new_empty(regions, own + pose)
    given = (face.expression, face.joints, face.head_rotation, face.head_translation)
    launch(
        _activations, regions, *(one.contiguous() for one in given), buffers.rest, buffers.directions, buffers.seen,
        buffers.head_rest, buffers.head_directions, buffers.head_seen, table, expressions, inputs, regions * own,
        len(buffers.seen), len(buffers.head_seen), margin, least, OWN=own, POSE=pose,
        INPUTS=triton.next_power_of_2(max(inputs, 1)), WIDE=triton.next_power_of_2(max(own, 1)),
        HIGH=triton.next_power_of_2(max(pose, 1)), SEEN=_SEEN,
    )  # fmt: skip
    return torch.mm(buffers.shares, table)


@no_type_check
@triton.jit
def _shortened(values, seen, rows, columns, first, inside, margin, least, WIDE: tl.constexpr, SEEN: tl.constexpr):
    """`within_seen` of values that begin at column `first` of what was seen."""
    if rows > 0:
        column, furthest = tl.arange(0, WIDE), tl.sum(values, 0) * 0.0 + least
        for start in range(0, rows, SEEN):
            row = start + tl.arange(0, SEEN)
            known = (row < rows)[:, None] & inside[None, :]
            at = row[:, None] * columns + first + column[None, :]
            along = tl.sum(tl.load(seen + at, mask=known, other=0.0) * values[None, :], 1)
            furthest = tl.maximum(furthest, tl.max(along, 0))
        ratio = tl.sum(values * values, 0) / furthest
        over = tl.maximum(ratio - 1, 0.0)
        values *= tl.where(over > 0, (1 + margin * over / (margin + over)) / tl.maximum(ratio, 1.0), 1.0)
    return values


@no_type_check
@triton.jit
def _activations(
    expression, joints, rotation, translation, rest, directions, seen, head_rest, head_directions, head_seen, table,
    expressions, inputs, columns, rows, head_rows, margin, least, OWN: tl.constexpr, POSE: tl.constexpr,
    INPUTS: tl.constexpr, WIDE: tl.constexpr, HIGH: tl.constexpr, SEEN: tl.constexpr,
):  # fmt: skip
    region, number, column = tl.program_id(0), tl.arange(0, INPUTS), tl.arange(0, WIDE)
    given = tl.load(expression + number, mask=number < expressions, other=0.0)
    of_joints = (number >= expressions) & (number < inputs)
    given += tl.load(joints + number - expressions, mask=of_joints, other=0.0)
    given -= tl.load(rest + number, mask=number < inputs, other=0.0)
    first, inside = region * OWN, column < OWN
    known = (number < inputs)[:, None] & inside[None, :]
    along = tl.load(directions + number[:, None] * columns + first + column[None, :], mask=known, other=0.0)
    own = tl.sum(given[:, None] * along, 0)
    own = _shortened(own, seen, rows, columns, first, inside, margin, least, WIDE, SEEN)
    # Activations of the region and of the pose take turns, as long as there are both.
    result = table + region * (OWN + POSE)
    tl.store(result + tl.where(column < POSE, 2 * column, POSE + column), own, mask=inside)
    if POSE > 0:
        a, b, c = tl.load(head_rest), tl.load(head_rest + 1), tl.load(head_rest + 2)
        x, y, z = tl.load(rotation), tl.load(rotation + 1), tl.load(rotation + 2)
        numbers = tl.arange(0, HIGH)
        pose = tl.load(head_directions + numbers, mask=numbers < POSE, other=0.0) * 0.0
        for i in tl.static_range(3):
            sine, shift = 0.0 * x, 0.0 * x
            for m in tl.static_range(3):
                sine += rotation_entry(m, (i + 2) % 3, a, b, c) * rotation_entry(m, (i + 1) % 3, x, y, z)
                sine -= rotation_entry(m, (i + 1) % 3, a, b, c) * rotation_entry(m, (i + 2) % 3, x, y, z)
                shift += (tl.load(translation + m) - tl.load(head_rest + 3 + m)) * rotation_entry(m, i, a, b, c)
            pose += sine / 2 * tl.load(head_directions + POSE * i + numbers, mask=numbers < POSE, other=0.0)
            pose += shift * tl.load(head_directions + POSE * (3 + i) + numbers, mask=numbers < POSE, other=0.0)
        pose = _shortened(pose, head_seen, head_rows, POSE, 0, numbers < POSE, margin, least, HIGH, SEEN)
        tl.store(result + tl.where(numbers < OWN, 2 * numbers + 1, OWN + numbers), pose, mask=numbers < POSE)
