"""Posing of a face in kernels for a GPU: four launches forward and four backward, for one timestep.

A program moves the joints of a timestep: its lanes are the joints, and one more, which is the head in the world.
Products with the face model's bases and skinning weights are matrix products.
"""

from typing import TYPE_CHECKING, Any, no_type_check
from weakref import WeakKeyDictionary

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.face.params import FaceParams
from mien.face.posing import RestShape
from mien.kernels import blocks, launch

if TYPE_CHECKING:
    from mien.face.model import FaceModel

_BLOCK = 128


def pose_face(model: "FaceModel", face: FaceParams, in_world: bool) -> tuple[Tensor, Tensor] | None:
    """Vertices [1, v, 3] in the world or in the head frame, and the head's pose [1, 4, 4].

    They are differentiable in what changes from timestep to timestep. None if the person's shape has a gradient.
    """
    constants = _constants(model)
    rest, joints = constants.rest.of(model, face)
    if rest.requires_grad or joints.requires_grad:
        return None
    motion = (face.expression, face.joints, face.head_rotation, face.head_translation)
    return _Pose.apply(constants, in_world, rest, joints, *motion)  # pyright: ignore[reportReturnType]


def head_poses(rotation: Tensor, translation: Tensor) -> Tensor:
    """`mien.face.posing.head_poses`: one launch forward and one backward."""
    return _HeadPoses.apply(rotation, translation)  # pyright: ignore[reportReturnType]


def move_bones(
    model: "FaceModel", face: FaceParams, T_world_rest: Tensor, slots: Tensor, bones: int
) -> tuple[Tensor, Tensor] | None:
    """Expression and pose features [b, c], and transforms [b, bones, 3, 4] in the head frame.

    `slots` says which of the bones a joint is, or -1. The last bone stands still in the world while the head moves from
    `T_world_rest`. None if the person's shape has a gradient.
    """
    constants = _constants(model)
    _, joints = constants.rest.of(model, face)
    if joints.requires_grad:
        return None
    motion = (face.expression, face.joints, face.head_rotation, face.head_translation)
    return _Bones.apply(constants, joints, T_world_rest, slots, bones, *motion)  # pyright: ignore[reportReturnType]


class _HeadPoses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rotation: Tensor, translation: Tensor) -> Tensor:
        rotation, b = rotation.contiguous(), len(rotation)
        poses = rotation.new_empty(b, 4, 4)
        launch(_pose_heads, blocks(b, _BLOCK), rotation, translation.contiguous(), poses, b, BLOCK=_BLOCK)
        ctx.save_for_backward(rotation)
        return poses

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_poses: Tensor) -> tuple[Tensor, Tensor]:
        (rotation,) = ctx.saved_tensors
        results, b = (torch.empty_like(rotation), torch.empty_like(rotation)), len(rotation)
        launch(_pose_heads_backward, blocks(b, _BLOCK), rotation, by_poses.contiguous(), *results, b, BLOCK=_BLOCK)
        return results


class _Constants:
    """A face model as the kernels take it."""

    def __init__(self, model: "FaceModel"):
        self.rest = RestShape()
        bases = [model.expression_basis] if model.pose_basis is None else [model.expression_basis, model.pose_basis]
        self.basis = torch.cat(bases).flatten(1).contiguous()
        self.weights = model.skinning_weights.contiguous()
        self.turns, self.shifts = model.joint_rotation_basis.contiguous(), model.joint_translation_basis.contiguous()
        free = iter(range(len(model.joint_free)))
        places = [next(free) if one else -1 for one in model.joint_free]
        like = model.template.device
        self.parents = torch.tensor([*model.joint_parents, -1], dtype=torch.int32).to(like)
        self.free = torch.tensor(places, dtype=torch.int32).to(like)


def _constants(model: "FaceModel") -> _Constants:
    known = _known.get(model)
    if known is None:
        known = _known[model] = _Constants(model)
    return known


_known: "WeakKeyDictionary[FaceModel, _Constants]" = WeakKeyDictionary()


def _sizes(k: int, e: int, *, in_world: bool, corrected: bool) -> dict[str, Any]:
    """Constants of the kernels that move joints. `corrected`: whether there are pose features."""
    lanes = {"JOINTS": triton.next_power_of_2(k + 1), "EXPRESSIONS": triton.next_power_of_2(max(e, 1))}
    return {"IN_WORLD": in_world, "CORRECTED": corrected, **lanes}


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, own: _Constants, in_world: bool, *given: Tensor) -> tuple[Tensor, Tensor]:
        rest, joint_rest, *motion = (tensor.contiguous() for tensor in given)
        k, v, e, j = len(joint_rest), len(rest), motion[0].shape[1], motion[1].shape[1]
        local, transforms, factors = (
            rest.new_empty(k + 1, 12),
            rest.new_empty(k + 1, 12),
            rest.new_empty(len(own.basis)),
        )
        pose, vertices, shaped = rest.new_empty(1, 4, 4), rest.new_empty(1, v, 3), rest.new_empty(v, 3)
        joints = (*motion, joint_rest, own.turns, own.shifts, own.parents, own.free, k, e, j)
        sizes = _sizes(k, e, in_world=in_world, corrected=len(own.basis) > e)
        launch(_move_joints, 1, *joints, local, transforms, factors, pose, **sizes)
        moved, blended = torch.mv(own.basis.T, factors), torch.mm(own.weights, transforms[:k])
        launch(_skin, blocks(v, _BLOCK), rest, moved, blended, shaped, vertices, v, BLOCK=_BLOCK)
        ctx.own, ctx.joints, ctx.sizes = own, joints[4:], sizes
        ctx.save_for_backward(*motion, local, transforms, shaped, blended)
        return vertices, pose

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_vertices: Tensor, by_pose: Tensor) -> tuple[Tensor | None, ...]:
        *motion, local, transforms, shaped, blended = ctx.saved_tensors
        own, v = ctx.own, len(shaped)
        by_shaped, outer = torch.empty_like(shaped), torch.empty_like(blended)
        by_vertices = by_vertices.contiguous()
        launch(_skin_backward, blocks(v, _BLOCK), by_vertices, blended, shaped, by_shaped, outer, v, BLOCK=_BLOCK)
        by_factors, by_joints = torch.mv(own.basis, by_shaped.view(-1)), torch.mm(own.weights.T, outer)
        results = [torch.empty_like(tensor) for tensor in motion]
        scratch = torch.empty_like(local), torch.empty_like(local)
        launch(
            _move_joints_backward, 1, *motion, *ctx.joints, local, transforms, by_joints, by_pose.contiguous(),
            by_factors, *scratch, *results, **ctx.sizes,
        )  # fmt: skip
        return None, None, None, None, *results


class _Bones(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, own: _Constants, joint_rest: Tensor, rest_pose: Tensor, slots: Tensor, count: int, *given: Tensor
    ) -> tuple[Tensor, Tensor]:
        joint_rest, rest_pose, *motion = (tensor.contiguous() for tensor in (joint_rest, rest_pose, *given))
        (b, e), j, k, empty = motion[0].shape, motion[1].shape[1], len(joint_rest), joint_rest.new_empty
        local, transforms, poses = empty(b, k + 1, 12), empty(b, k + 1, 12), empty(b, 4, 4)
        coefficients, bones = empty(b, e + 9 * j), empty(b, count, 3, 4)
        ctx.joints = (joint_rest, own.turns, own.shifts, own.parents, own.free, k, e, j)
        ctx.sizes, lanes = _sizes(k, e, in_world=False, corrected=True), triton.next_power_of_2(k + 1)
        launch(_move_joints, b, *motion, *ctx.joints, local, transforms, coefficients, poses, **ctx.sizes)
        launch(_choose_bones, b, transforms, poses, rest_pose, slots, bones, k, count, JOINTS=lanes)
        ctx.save_for_backward(*motion, local, transforms, poses, rest_pose, slots)
        return coefficients, bones

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_coefficients: Tensor, by_bones: Tensor) -> tuple[Tensor | None, ...]:
        *motion, local, transforms, poses, rest_pose, slots = ctx.saved_tensors
        b, k, by_bones = len(poses), local.shape[1] - 1, by_bones.contiguous()
        by_transforms, by_poses = local.new_empty(b, k, 12), torch.empty_like(poses)
        given, results = (poses, rest_pose, slots), [torch.empty_like(tensor) for tensor in motion]
        launch(
            _choose_bones_backward, b, by_bones, *given, by_transforms, by_poses, k, by_bones.shape[1],
            JOINTS=ctx.sizes["JOINTS"],
        )  # fmt: skip
        launch(
            _move_joints_backward, b, *motion, *ctx.joints, local, transforms, by_transforms, by_poses,
            by_coefficients.contiguous(), torch.empty_like(local), torch.empty_like(local), *results, **ctx.sizes,
        )  # fmt: skip
        return *[None] * 5, *results


@no_type_check
@triton.jit
def _pose_heads(rotation, translation, poses, b, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y = (
        tl.load(rotation + 3 * row, mask=row < b, other=0.0),
        tl.load(rotation + 3 * row + 1, mask=row < b, other=0.0),
    )
    z = tl.load(rotation + 3 * row + 2, mask=row < b, other=0.0)
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            tl.store(poses + 16 * row + 4 * i + j, rotation_entry(i, j, x, y, z), mask=row < b)
        place = tl.load(translation + 3 * row + i, mask=row < b, other=0.0)
        tl.store(poses + 16 * row + 4 * i + 3, place, mask=row < b)
        tl.store(poses + 16 * row + 12 + i, x * 0.0, mask=row < b)
    tl.store(poses + 16 * row + 15, x * 0.0 + 1.0, mask=row < b)


@no_type_check
@triton.jit
def _pose_heads_backward(rotation, by_poses, by_rotation, by_translation, b, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y = (
        tl.load(rotation + 3 * row, mask=row < b, other=0.0),
        tl.load(rotation + 3 * row + 1, mask=row < b, other=0.0),
    )
    z = tl.load(rotation + 3 * row + 2, mask=row < b, other=0.0)
    by_x, by_y, by_z = x * 0.0, x * 0.0, x * 0.0
    for i in tl.static_range(3):
        place = tl.load(by_poses + 16 * row + 4 * i + 3, mask=row < b, other=0.0)
        tl.store(by_translation + 3 * row + i, place, mask=row < b)
        for j in tl.static_range(3):
            own = tl.load(by_poses + 16 * row + 4 * i + j, mask=row < b, other=0.0)
            to_x, to_y, to_z = _by_entry(i, j, own, x, y, z)
            by_x, by_y, by_z = by_x + to_x, by_y + to_y, by_z + to_z
    tl.store(by_rotation + 3 * row, by_x, mask=row < b)
    tl.store(by_rotation + 3 * row + 1, by_y, mask=row < b)
    tl.store(by_rotation + 3 * row + 2, by_z, mask=row < b)


@no_type_check
@triton.jit
def _skin(rest, moved, blended, shaped, vertices, v, BLOCK: tl.constexpr):
    row, axis = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4)
    at, there = 3 * row[:, None] + axis[None, :], (row < v)[:, None] & (axis < 3)[None, :]
    own = tl.load(rest + at, mask=there, other=0.0) + tl.load(moved + at, mask=there, other=0.0)
    tl.store(shaped + at, own, mask=there)
    point = tl.where((axis == 3)[None, :], 1.0, own)
    for i in tl.static_range(3):
        of_row = tl.load(blended + 12 * row[:, None] + 4 * i + axis[None, :], mask=(row < v)[:, None], other=0.0)
        tl.store(vertices + 3 * row + i, tl.sum(of_row * point, 1), mask=row < v)


@no_type_check
@triton.jit
def _skin_backward(by_vertices, blended, shaped, by_shaped, outer, v, BLOCK: tl.constexpr):
    row, axis = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, 4)
    at, there = 3 * row[:, None] + axis[None, :], (row < v)[:, None] & (axis < 3)[None, :]
    point = tl.where((axis == 3)[None, :], 1.0, tl.load(shaped + at, mask=there, other=0.0))
    result = point * 0.0
    for i in tl.static_range(3):
        at_row, known = 12 * row[:, None] + 4 * i + axis[None, :], (row < v)[:, None]
        gradient = tl.load(by_vertices + 3 * row + i, mask=row < v, other=0.0)[:, None]
        result += gradient * tl.load(blended + at_row, mask=known, other=0.0)
        tl.store(outer + at_row, gradient * point, mask=known)
    tl.store(by_shaped + at, result, mask=there)


@no_type_check
@triton.jit
def _turn(
    axis: tl.constexpr, expression, joints, head, turns, free, k, e, JOINTS: tl.constexpr, EXPRESSIONS: tl.constexpr
):
    """One number of each joint's axis-angle vector, and of the head's in the last lane."""
    joint = tl.arange(0, JOINTS)
    place = tl.load(free + joint, mask=joint < k, other=-1)
    given = tl.load(joints + 3 * place + axis, mask=place >= 0, other=0.0)
    derived = _derived(axis, expression, turns, k, e, JOINTS, EXPRESSIONS)
    return tl.where(joint == k, tl.load(head + axis), tl.where(place >= 0, given, derived))


@no_type_check
@triton.jit
def _derived(axis: tl.constexpr, expression, basis, k, e, JOINTS: tl.constexpr, EXPRESSIONS: tl.constexpr):
    """Add up one number of each joint over the expression."""
    joint, number = tl.arange(0, JOINTS), tl.arange(0, EXPRESSIONS)
    at, there = (number[:, None] * k + joint[None, :]) * 3 + axis, (number < e)[:, None] & (joint < k)[None, :]
    own = tl.load(expression + number, mask=number < e, other=0.0)
    return tl.sum(own[:, None] * tl.load(basis + at, mask=there, other=0.0), 0)


@no_type_check
@triton.jit
def rotation_factors(x, y, z):
    """Sin a / a, (1 - cos a) / a^2 and cos a of the angle a, and derivatives of the first two, divided by a."""
    squared = x * x + y * y + z * z
    small = squared < 1e-8
    safe = tl.where(small, 1.0, squared)
    angle = tl.sqrt(safe)
    sine = tl.where(small, 1 - squared / 6, tl.sin(angle) / angle)
    cosine = tl.where(small, 0.5 - squared / 24, (1 - tl.cos(angle)) / safe)
    straight = 1 - cosine * squared
    by_sine = tl.where(small, -1.0 / 3, (straight - sine) / safe)
    by_cosine = tl.where(small, -1.0 / 12, (sine - 2 * cosine) / safe)
    return sine, cosine, straight, by_sine, by_cosine


@no_type_check
@triton.jit
def rotation_entry(i: tl.constexpr, j: tl.constexpr, x, y, z):
    """A number of a rotation's matrix: cos a I + sin a / a [v]x + (1 - cos a) / a^2 v v^T."""
    sine, cosine, straight, _, _ = rotation_factors(x, y, z)
    vector, cross = (x, y, z), ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    value = sine * cross[i][j] + cosine * vector[i] * vector[j]
    return value + straight if i == j else value


@no_type_check
@triton.jit
def _by_entry(i: tl.constexpr, j: tl.constexpr, gradient, x, y, z):
    """The derivative by a rotation's vector of that number, times a gradient."""
    sine, cosine, _, by_sine, by_cosine = rotation_factors(x, y, z)
    vector, cross = (x, y, z), ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    along = by_sine * cross[i][j] + by_cosine * vector[i] * vector[j]
    if i == j:
        along -= sine
    to_x, to_y, to_z = along * x, along * y, along * z
    # Which of x, y and z stands in the cross product's matrix, with its sign.
    if i != j:
        sign: tl.constexpr = 1.0 if (j + 1) % 3 == i else -1.0
        if 3 - i - j == 0:
            to_x += sign * sine
        elif 3 - i - j == 1:
            to_y += sign * sine
        else:
            to_z += sign * sine
    to_x += cosine * ((i == 0) * vector[j] + (j == 0) * vector[i])
    to_y += cosine * ((i == 1) * vector[j] + (j == 1) * vector[i])
    to_z += cosine * ((i == 2) * vector[j] + (j == 2) * vector[i])
    return gradient * to_x, gradient * to_y, gradient * to_z


@no_type_check
@triton.jit
def _parent(parents, index, k, IN_WORLD: tl.constexpr):
    """The joint that a joint moves with, or -1. In the world, all move with the head's lane, the last."""
    parent = tl.load(parents + index)
    if IN_WORLD:
        parent = tl.where((parent < 0) & (index < k), k, parent)
    return parent


@no_type_check
@triton.jit
def _of_parent(transforms, parent, row, middle):
    """The transform of a parent, or the identity, as [4, 4, 1]; the last row is not used."""
    has_parent = parent + 0 * row >= 0
    known = tl.load(transforms + 12 * parent + 4 * row + middle, mask=(row < 3) & has_parent, other=0.0)
    return tl.where(has_parent, known, tl.where(row == middle, 1.0, 0.0))


@no_type_check
@triton.jit
def _homogeneous(local, index, middle, column):
    known = tl.load(local + 12 * index + 4 * middle + column, mask=middle < 3, other=0.0)
    return tl.where((middle == 3) & (column == 3), 1.0, known)


@no_type_check
@triton.jit
def _move_joints(
    expression, joints, rotation, translation, joint_rest, turns, shifts, parents, free, k, e, given_joints, local,
    transforms, factors, pose, IN_WORLD: tl.constexpr, CORRECTED: tl.constexpr, JOINTS: tl.constexpr,
    EXPRESSIONS: tl.constexpr,
):  # fmt: skip
    timestep = tl.program_id(0)
    expression, joints, rotation = (
        expression + timestep * e,
        joints + timestep * 3 * given_joints,
        rotation + timestep * 3,
    )
    translation, pose = translation + timestep * 3, pose + timestep * 16
    local, transforms = local + timestep * 12 * (k + 1), transforms + timestep * 12 * (k + 1)
    factors += timestep * (e + 9 * given_joints if CORRECTED else e)
    joint, number = tl.arange(0, JOINTS), tl.arange(0, EXPRESSIONS)
    there, place = joint <= k, tl.load(free + joint, mask=joint < k, other=-1)
    x = _turn(0, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    y = _turn(1, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    z = _turn(2, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    for i in tl.static_range(3):
        rest = tl.load(joint_rest + 3 * joint + i, mask=joint < k, other=0.0)
        about = rest + _derived(i, expression, shifts, k, e, JOINTS, EXPRESSIONS)
        about += tl.where(joint == k, tl.load(translation + i), 0.0)
        for j in tl.static_range(3):
            turned = rotation_entry(i, j, x, y, z)
            tl.store(local + 12 * joint + 4 * i + j, turned, mask=there)
            about -= turned * tl.load(joint_rest + 3 * joint + j, mask=joint < k, other=0.0)
            if CORRECTED:
                at = factors + e + 9 * place + 3 * i + j
                if i == j:
                    turned -= 1.0
                tl.store(at, turned, mask=place >= 0)
        tl.store(local + 12 * joint + 4 * i + 3, about, mask=there)
    tl.store(factors + number, tl.load(expression + number, mask=number < e, other=0.0), mask=number < e)
    tl.debug_barrier()  # Other threads read what this one wrote.
    row, middle, column = tl.arange(0, 4)[:, None, None], tl.arange(0, 4)[None, :, None], tl.arange(0, 4)[None, None, :]
    at, kept = 4 * tl.arange(0, 4)[:, None] + tl.arange(0, 4)[None, :], (tl.arange(0, 4) < 3)[:, None]
    for step in range(k + 1):
        index = tl.where(step == 0, k, step - 1)
        parent = _parent(parents, index, k, IN_WORLD)
        chained = tl.sum(_of_parent(transforms, parent, row, middle) * _homogeneous(local, index, middle, column), 1)
        tl.store(transforms + 12 * index + at, chained, mask=kept)
        tl.debug_barrier()
    fourth = tl.where(tl.arange(0, 4)[None, :] == 3, 1.0, 0.0)
    tl.store(pose + at, tl.where(kept, tl.load(local + 12 * k + at, mask=kept, other=0.0), fourth))


@no_type_check
@triton.jit
def _move_joints_backward(
    expression, joints, rotation, translation, joint_rest, turns, shifts, parents, free, k, e, given_joints, local,
    transforms, given, by_pose, by_factors, by_transforms, by_local, by_expression, by_joints, by_rotation,
    by_translation, IN_WORLD: tl.constexpr, CORRECTED: tl.constexpr, JOINTS: tl.constexpr, EXPRESSIONS: tl.constexpr,
):  # fmt: skip
    timestep = tl.program_id(0)
    expression, by_expression = expression + timestep * e, by_expression + timestep * e
    joints, by_joints = joints + timestep * 3 * given_joints, by_joints + timestep * 3 * given_joints
    rotation, by_rotation = rotation + timestep * 3, by_rotation + timestep * 3
    by_translation, by_pose, given = by_translation + timestep * 3, by_pose + timestep * 16, given + timestep * 12 * k
    of_all = timestep * 12 * (k + 1)
    local, transforms = local + of_all, transforms + of_all
    by_local, by_transforms = by_local + of_all, by_transforms + of_all
    by_factors += timestep * (e + 9 * given_joints if CORRECTED else e)
    joint, number = tl.arange(0, JOINTS), tl.arange(0, EXPRESSIONS)
    four = tl.arange(0, 4)
    at, kept = 4 * four[:, None] + four[None, :], (four < 3)[:, None]
    for index in range(k):
        tl.store(by_transforms + 12 * index + at, tl.load(given + 12 * index + at, mask=kept), mask=kept)
    tl.store(by_transforms + 12 * k + at, tl.load(by_pose + at, mask=kept), mask=kept)
    tl.debug_barrier()
    row, middle, column = four[:, None, None], four[None, :, None], four[None, None, :]
    for step in range(k + 1):
        index = tl.where(step == k, k, k - 1 - step)
        parent = _parent(parents, index, k, IN_WORLD)
        gradient = tl.load(by_transforms + 12 * index + 4 * row + column, mask=row < 3, other=0.0)
        turned = tl.where(row < 3, _of_parent(transforms, parent, row, middle), 0.0)
        tl.store(by_local + 12 * index + at, tl.sum(turned * gradient, 0), mask=kept)
        back = tl.sum(gradient * _homogeneous(local, index, middle, column), 2)
        of_parent, known = by_transforms + 12 * parent + at, kept & (parent + 0 * at >= 0)
        back += tl.load(of_parent, mask=known, other=0.0)
        tl.debug_barrier()
        tl.store(of_parent, back, mask=known)
        tl.debug_barrier()
    x = _turn(0, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    y = _turn(1, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    z = _turn(2, expression, joints, rotation, turns, free, k, e, JOINTS, EXPRESSIONS)
    there, place = joint <= k, tl.load(free + joint, mask=joint < k, other=-1)
    result = tl.load(by_factors + number, mask=number < e, other=0.0)
    by_x, by_y, by_z = x * 0.0, x * 0.0, x * 0.0
    for i in tl.static_range(3):
        moved = tl.load(by_local + 12 * joint + 4 * i + 3, mask=there, other=0.0)
        result += _back_to_expression(i, moved, shifts, joint < k, k, e, JOINTS, EXPRESSIONS)
        tl.store(by_translation + i + 0 * joint, moved, mask=joint == k)
        for j in tl.static_range(3):
            own = tl.load(by_local + 12 * joint + 4 * i + j, mask=there, other=0.0)
            own -= moved * tl.load(joint_rest + 3 * joint + j, mask=joint < k, other=0.0)
            if CORRECTED:
                own += tl.load(by_factors + e + 9 * place + 3 * i + j, mask=place >= 0, other=0.0)
            to_x, to_y, to_z = _by_entry(i, j, own, x, y, z)
            by_x, by_y, by_z = by_x + to_x, by_y + to_y, by_z + to_z
    by_turns = by_x, by_y, by_z
    for i in tl.static_range(3):
        tl.store(by_joints + 3 * place + i, by_turns[i], mask=place >= 0)
        tl.store(by_rotation + i + 0 * joint, by_turns[i], mask=joint == k)
        result += _back_to_expression(i, by_turns[i], turns, (joint < k) & (place < 0), k, e, JOINTS, EXPRESSIONS)
    tl.store(by_expression + number, result, mask=number < e)


@no_type_check
@triton.jit
def _back_to_expression(
    axis: tl.constexpr, gradient, basis, chosen, k, e, JOINTS: tl.constexpr, EXPRESSIONS: tl.constexpr
):
    joint, number = tl.arange(0, JOINTS), tl.arange(0, EXPRESSIONS)
    at, there = (number[:, None] * k + joint[None, :]) * 3 + axis, (number < e)[:, None] & chosen[None, :]
    return tl.sum(tl.where(chosen, gradient, 0.0)[None, :] * tl.load(basis + at, mask=there, other=0.0), 1)


@no_type_check
@triton.jit
def _choose_bones(transforms, poses, rest_pose, slots, bones, k, count, JOINTS: tl.constexpr):
    """Transforms of the bones, and of the one that stands still: from the rest's head frame to that of the timestep."""
    transforms, poses = transforms + tl.program_id(0) * 12 * (k + 1), poses + tl.program_id(0) * 16
    bones, joint = bones + tl.program_id(0) * 12 * count, tl.arange(0, JOINTS)
    slot = tl.load(slots + joint, mask=joint < k, other=-1)
    for i in tl.static_range(12):
        own = tl.load(transforms + 12 * joint + i, mask=slot >= 0, other=0.0)
        tl.store(bones + 12 * slot + i, own, mask=slot >= 0)
    for i in tl.static_range(3):
        for j in tl.static_range(4):
            total = 0.0 * tl.load(poses)
            for a in tl.static_range(3):
                place = tl.load(rest_pose + 4 * a + j)
                if j == 3:
                    place -= tl.load(poses + 4 * a + 3)
                total += tl.load(poses + 4 * a + i) * place
            tl.store(bones + 12 * (count - 1) + 4 * i + j, total)


@no_type_check
@triton.jit
def _choose_bones_backward(
    by_bones, poses, rest_pose, slots, by_transforms, by_poses, k, count, JOINTS: tl.constexpr
):  # fmt: skip
    poses, by_poses = poses + tl.program_id(0) * 16, by_poses + tl.program_id(0) * 16
    by_transforms, by_bones = by_transforms + tl.program_id(0) * 12 * k, by_bones + tl.program_id(0) * 12 * count
    joint = tl.arange(0, JOINTS)
    slot = tl.load(slots + joint, mask=joint < k, other=-1)
    for i in tl.static_range(12):
        own = tl.load(by_bones + 12 * slot + i, mask=slot >= 0, other=0.0)
        tl.store(by_transforms + 12 * joint + i, own, mask=joint < k)
    given = by_bones + 12 * (count - 1)
    for a in tl.static_range(3):
        by_place = 0.0 * tl.load(poses)
        for i in tl.static_range(3):
            total = 0.0 * tl.load(poses)
            for j in tl.static_range(4):
                place = tl.load(rest_pose + 4 * a + j)
                if j == 3:
                    place -= tl.load(poses + 4 * a + 3)
                    by_place -= tl.load(poses + 4 * a + i) * tl.load(given + 4 * i + 3)
                total += place * tl.load(given + 4 * i + j)
            tl.store(by_poses + 4 * a + i, total)
        tl.store(by_poses + 4 * a + 3, by_place)
