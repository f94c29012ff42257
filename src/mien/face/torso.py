"""The torso: a rigid pose of its own in the world, which neck and bust of a face model follow.

Everything that poses a mesh (the core, kernels for a GPU, the runtime without torch, pages) knows joints that turn, and
coefficients that shift joints. `TorsoMotion` is the torso in these terms: how it turned and shifted relative to the
head. No engine has to know more.
"""

from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.params import FaceParams
from mien.rotation import (
    axis_angle_from_quaternion,
    matrix_from_axis_angle,
    multiply_quaternions,
    quaternion_from_axis_angle,
)

if TYPE_CHECKING:
    from mien.face.model import FaceModel


class TorsoMotion(NamedTuple):
    """A torso's motion in the head frame, relative to its rest: x -> R (x - p) + p + shift.

    p is the rest position of the joint `torso`. A joint with the share s of the motion turns by s R, about p as well,
    and shifts by s shift.
    """

    rotation: Float[Tensor, "b 3"]
    """Axis-angle in radians."""
    shift: Float[Tensor, "b 3"]
    """In metres."""


def torso_motion(model: "FaceModel", face: FaceParams) -> TorsoMotion:
    """Return how the torso moved relative to the head; not at all if `face` has no torso. It is differentiable."""
    if face.torso_rotation is None or face.torso_translation is None:
        none = torch.zeros_like(face.head_rotation)
        return TorsoMotion(none, none)
    of_head, of_torso = (quaternion_from_axis_angle(one) for one in (-face.head_rotation, face.torso_rotation))
    rotation = axis_angle_from_quaternion(multiply_quaternions(of_head, of_torso))
    offset = (face.torso_translation - face.head_translation)[:, None]
    return TorsoMotion(
        rotation, (offset @ matrix_from_axis_angle(face.head_rotation))[:, 0] - torso_origin(model, face)
    )


def torso_origin(model: "FaceModel", face: FaceParams) -> Float[Tensor, " 3"]:
    """Return the origin of the torso frame at rest, in the head frame: the rest position of the joint `torso`."""
    return model.rest_joints(face)[model.joint_names.index("torso")]


def resting_torso(model: "FaceModel", face: FaceParams) -> FaceParams:
    """Return the same faces with a torso that moves with the head, as on a head-only model whose neck is at rest."""
    turned = matrix_from_axis_angle(face.head_rotation) @ torso_origin(model, face)
    return face.with_torso(face.head_rotation, face.head_translation + turned)


def still_torso(model: "FaceModel", face: FaceParams, timestep: int = 0) -> FaceParams:
    """Return the same faces on the torso of one timestep, or on the one that rests below its head if it has none."""
    one = face[timestep]
    one = resting_torso(model, one) if one.torso_rotation is None else one
    assert one.torso_rotation is not None
    assert one.torso_translation is not None
    size = len(face)
    return face.with_torso(one.torso_rotation.expand(size, 3), one.torso_translation.expand(size, 3))


def torso_of_neck(model: "FaceModel", face: FaceParams, neck: Float[Tensor, "b 3"]) -> FaceParams:
    """Return the same faces with the torso that a head-only model's free joint `neck` stands for.

    Both turn about the same point, so the torso turned by the neck's rotation and did not shift.
    """
    to_world = quaternion_from_axis_angle(face.head_rotation)
    rotation = axis_angle_from_quaternion(multiply_quaternions(to_world, quaternion_from_axis_angle(neck)))
    turned = matrix_from_axis_angle(face.head_rotation) @ torso_origin(model, face)
    return face.with_torso(rotation, face.head_translation + turned)


TORSO_SHIFTS = ("torsoX", "torsoY", "torsoZ")
"""Names of the coefficients that stand for a torso's shift in `plain_model`."""


def plain_model(model: "FaceModel") -> "FaceModel":
    """Return the model without a torso of its own: for engines, files and pages, which need not know what a torso is.

    Joints that have a share of the torso's motion are free, and three more coefficients shift them, in metres.
    """
    shares = model.torso_shares
    if shares is None:
        return model
    shifts = torch.eye(3).to(shares)[:, None, :] * shares[:, None]
    none = model.template.new_zeros
    free = tuple(own or bool(share) for own, share in zip(model.joint_free, shares.tolist(), strict=True))
    basis = model.pose_basis
    if basis is not None:
        given = iter(basis.split(9))
        rows = [next(given) if own else none(9, len(model.template), 3) for own in compress(model.joint_free, free)]
        basis = torch.cat(rows)
    return replace(
        model,
        expression_basis=torch.cat([model.expression_basis, none(3, len(model.template), 3)]),
        expression_names=(*model.expression_names, *TORSO_SHIFTS),
        expression_bounds=torch.cat([model.expression_bounds, none(3, 2)]),
        expression_sigmas=None if model.expression_sigmas is None else torch.cat([model.expression_sigmas, none(3)]),
        joint_free=free,
        joint_rotation_basis=torch.cat([model.joint_rotation_basis, none(3, len(shares), 3)]),
        joint_translation_basis=torch.cat([model.joint_translation_basis, shifts]),
        pose_basis=basis,
        torso_shares=None,
    )


def plain_motion(model: "FaceModel", face: FaceParams) -> tuple[Float[Tensor, "b e"], Float[Tensor, "b j 3"]]:
    """Return expression and joints of `plain_model(model)` for these faces, differentiable in every field."""
    if model.torso_shares is None:
        return face.expression, face.joints
    motion, given = torso_motion(model, face), iter(face.joints.unbind(1))
    rows = [
        next(given) if free else share * motion.rotation
        for free, share in zip(model.joint_free, model.torso_share_numbers, strict=True)
        if free or share
    ]
    return torch.cat([face.expression, motion.shift], dim=1), torch.stack(rows, dim=1)


def plain_face(model: "FaceModel", face: FaceParams) -> FaceParams:
    """Return the same faces as parameters of `plain_model(model)`."""
    expression, joints = plain_motion(model, face)
    return replace(face, expression=expression, joints=joints, torso_rotation=None, torso_translation=None)
