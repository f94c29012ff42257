"""What a run was trained on: the largest coefficients, and the sides from which the camera saw the head."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.params import FaceParams
from mien.lab.analysis.context import Context
from mien.runtime.filmed import head_angles


@dataclass(frozen=True, eq=False)
class Trained:
    """The range of a training."""

    highest: Float[Tensor, " e"]
    """The largest value of each expression coefficient."""
    yaws: tuple[float, float]
    """Yaw of the camera as the head sees it, from the lowest to the highest, in radians. Positive is the subject's
    left."""
    yaw_at_rest: float
    """The same for the subject and the run's camera, in radians."""


def trained_range(context: Context) -> Trained:
    """The range of the run's training, from its avatar, or from its sequences if the avatar does not hold it."""
    avatar, filmed = context.avatar, context.avatar.filmed
    at_rest = float(_angles(avatar.subject, context.camera.position)[0, 0])
    count = avatar.subject.expression.shape[1]
    if filmed is not None:
        low, high = (float(value) for value in filmed.head_angles[0])
        return Trained(torch.from_numpy(filmed.highest[:count].copy()), (low, high), at_rest)
    faces = [one.tracking.face for one in context.sequences]
    yaws = [
        _angles(one.tracking.face, camera.position)[:, 0]
        for one in context.sequences
        for camera in one.tracking.cameras
    ]
    together = np.concatenate(yaws)
    highest = torch.cat([face.expression for face in faces]).amax(0)
    return Trained(highest, (float(together.min()), float(together.max())), at_rest)


def with_expression(face: FaceParams, index: int, value: float) -> FaceParams:
    """The face with one expression coefficient set to a value."""
    expression = face.expression.clone()
    expression[:, index] = value
    return replace(face, expression=expression)


def busy_face(context: Context) -> FaceParams:
    """The subject with all expressions at a tenth of their largest bound, so that every basis is read."""
    avatar = context.avatar
    return replace(
        avatar.subject, expression=avatar.subject.expression + 0.1 * avatar.face_model.expression_bounds[:, 1]
    )


def _angles(face: FaceParams, eye: Tensor) -> np.ndarray:
    rotation, translation, position = (
        tensor.detach().cpu().numpy() for tensor in (face.head_rotation, face.head_translation, eye)
    )
    return head_angles(rotation, translation, position)
