"""The torso of a face model: a joint `torso` that turns and shifts against the head.

Everything that poses a mesh (the core, kernels for a GPU, the runtime without torch, pages) knows free joints and
coefficients that shift joints, and a torso is nothing else: the joints `torso` and `neck`, about one point, and the
coefficients `TORSO_SHIFTS`. This module goes from its pose in the world to these and back.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.params import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.torso import FREE, NECK_SHARE, TORSO, TORSO_SHIFTS, StillTorso

if TYPE_CHECKING:
    from mien.face.model import FaceModel


class TorsoPose(NamedTuple):
    """A torso's pose in the world. Its frame is parallel to the head's, and at the joint `torso`, while it rests."""

    rotation: Float[Tensor, "b 3"]
    """Axis-angle in radians."""
    translation: Float[Tensor, "b 3"]
    """In metres."""


def has_torso(model: "FaceModel") -> bool:
    """Whether the face model has a torso."""
    return TORSO in model.joint_names


def build_directions(model: "FaceModel") -> slice:
    """Return which identity directions move no part of the head: the last ones of a model with a torso, else none."""
    count = len(model.identity_basis)
    if not has_torso(model):
        return slice(count, count)
    moves_head = model.identity_basis[:, model.skinning_weights[:, 0] == 1].flatten(1).any(1)
    return slice(int(moves_head.nonzero().max()) + 1, count)


def torso_origin(model: "FaceModel", face: FaceParams) -> Float[Tensor, " 3"]:
    """Return the origin of the torso frame at rest, in the head frame: the rest position of the joint `torso`."""
    return model.rest_joints(face)[model.joint_names.index(TORSO)]


def motion_of(
    pose: TorsoPose, face: FaceParams, origin: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Return how a torso in the world turned and shifted against the head, in the head frame. It is differentiable."""
    to_world = matrix_from_axis_angle(face.head_rotation)
    offset = (pose.translation - face.head_translation)[:, None]
    return to_world.mT @ matrix_from_axis_angle(pose.rotation), (offset @ to_world)[:, 0] - origin


def with_torso(model: "FaceModel", face: FaceParams, pose: TorsoPose) -> FaceParams:
    """Return the same heads on torsos with these poses."""
    rotation, shift = motion_of(pose, face, torso_origin(model, face))
    return _against_head(model, face, axis_angle_from_matrix(rotation), shift)


def _against_head(
    model: "FaceModel", face: FaceParams, turn: Float[Tensor, "b 3"], shift: Float[Tensor, "b 3"]
) -> FaceParams:
    joints, expression, free = face.joints.clone(), face.expression.clone(), model.free_joint_names
    joints[:, free.index(TORSO)], joints[:, free.index("neck")] = turn, NECK_SHARE * turn
    first = model.expression_names.index(TORSO_SHIFTS[0])
    expression[:, first : first + 3] = shift
    return replace(face, joints=joints, expression=expression)


def torso_pose(model: "FaceModel", face: FaceParams) -> TorsoPose:
    """Return where the torsos of some faces are in the world."""
    to_world = matrix_from_axis_angle(face.head_rotation)
    turned = to_world @ matrix_from_axis_angle(face.joints[:, model.free_joint_names.index(TORSO)])
    first = model.expression_names.index(TORSO_SHIFTS[0])
    place = torso_origin(model, face) + face.expression[:, first : first + 3]
    return TorsoPose(axis_angle_from_matrix(turned), face.head_translation + (to_world @ place[:, :, None])[:, :, 0])


def still_torso(model: "FaceModel", face: FaceParams, like: FaceParams, free: float = FREE) -> FaceParams:
    """Return the same heads on a torso that stands where that of `like`, a single timestep, is.

    A head that goes further than `free` from its place, in metres, takes the torso with it (`StillTorso`). Faces of a
    model without a torso come back as they are.
    """
    if not has_torso(model):
        return face
    rotation, translation = torso_pose(model, like)
    arrays = (matrix_from_axis_angle(rotation)[0], translation[0], torso_origin(model, like))
    still = StillTorso(*map(_as_array, arrays))
    found = still.against_head(_as_array(face.head_rotation), _as_array(face.head_translation), free)
    return _against_head(model, face, *(torch.from_numpy(one).to(face.joints) for one in found))


def _as_array(values: Tensor) -> np.ndarray:
    return values.detach().double().cpu().numpy()
