"""The face at rest of a person who may never rest: the calmest frames, unless they are far from the model's neutral.

A tracker always sees a little in a face at rest, such as raised brows, and this belongs to the person. A grin, an open
mouth, or a gaze to the side that lasts for the whole clip does not: it is motion and must reach the avatar.

The limits come from the spread of calm frames (`docs/log.md`): in nine tracked real sequences, coefficients are up to
0.22, gazes up to 11 and heads up to 18 degrees to the side; in ten synthetic ones, 0.28 (0.36 in a clip of eight
frames), 12 and 26 degrees. So what is within a limit stays as it is. Beyond it, the face at rest goes back to the
model's neutral, and is there at the second limit: what the avatar does grows without a jump.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams, most_frontal_camera
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle

REST_EXPRESSION = (0.3, 0.6)
"""Limits of a coefficient of ARKit: up to the first it belongs to the person, from the second on it is motion.
Measured: calm tenths of nine real sequences have 0.22 at most, of ten drawn ones 0.28 (log, 11-25)."""
REST_HEAD = (0.524, 0.785)
"""The same for the angle between the head and the direction to the camera, in radians: 30 and 45 degrees. A camera
aside is common, so these limits are wide. Measured: 18 degrees at most, 26 on drawn people."""
REST_GAZE = (0.262, 0.384)
"""The same for the angle of the gaze, in radians: 15 and 22 degrees. Eyes that look ahead or into the camera are at
rest however the head is turned. Measured: 11 degrees at most, 12 on drawn people."""
_REST_JAW = (0.12, 0.24)  # the same for a jaw that is a joint, in radians
_REST_SIGMAS_OF_ONE = 5.0  # deviations of a model's coefficient that count as 1 of ARKit: the limits are 1.5 and 3

_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


@dataclass(frozen=True, eq=False)
class AtRest:
    """A face at rest, as one timestep."""

    face: FaceParams
    moved: tuple[str, ...] = ()
    """What was too far from the model's neutral, and counts as motion, with its size."""


def facing(viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "3 3"]:
    """R_world_head of a head that looks along a camera's axis into the camera."""
    return viewmat[:3, :3].T @ _OPENCV.to(viewmat)


def rest_before(calm: FaceParams, model: FaceModel, cameras: tuple[Camera, ...]) -> AtRest:
    """`rest_of` for the camera that the face looks at most directly."""
    return rest_of(calm, model, facing(cameras[most_frontal_camera(cameras, calm)].viewmat))


def rest_of(calm: FaceParams, model: FaceModel, ahead: Float[Tensor, "3 3"] | None = None) -> AtRest:
    """The face at rest of a person with these calm frames (one timestep, see `neutral_of`).

    `ahead` is R_world_head of a head that looks at the camera; the identity if None.
    """
    moved: list[str] = []
    ahead = torch.eye(3).to(calm.head_rotation) if ahead is None else ahead.to(calm.head_rotation)
    expression, joints, turn = calm.expression.clone(), calm.joints.clone(), calm.head_rotation
    units = torch.ones(expression.shape[1]).to(expression)
    if model.expression_sigmas is not None:
        units = _REST_SIGMAS_OF_ONE * model.expression_sigmas.to(expression)
    kept = kept_share((expression / units).abs(), REST_EXPRESSION)
    moved += [f"{model.expression_names[index]} {expression[0, index]:.2f}" for index in (kept[0] < 1).nonzero()[:, 0]]
    expression = torch.where(kept < 1, kept * expression, expression)

    away = axis_angle_from_matrix(ahead.T @ matrix_from_axis_angle(turn))
    head = float(kept_share(away.norm(dim=-1), REST_HEAD))
    if head < 1:
        moved.append(f"the head {_degrees(away[0].norm())} degrees to the side")
        turn = axis_angle_from_matrix(ahead @ matrix_from_axis_angle(head * away))
    names = [name.lower() for name in model.free_joint_names]
    eyes = [index for index, name in enumerate(names) if "eye" in name]
    for index in sorted({*range(len(names))} - {*eyes}):
        share = float(kept_share(joints[0, index].norm(), _REST_JAW if "jaw" in names[index] else REST_HEAD))
        if share < 1:
            moved.append(f"{model.free_joint_names[index]} {_degrees(joints[0, index].norm())} degrees")
            joints[0, index] *= share
    if eyes:
        angle = _gaze(joints[:, eyes], ahead.T @ matrix_from_axis_angle(calm.head_rotation))
        gaze = float(kept_share(angle, REST_GAZE))
        if gaze < 1:
            moved.append(f"the gaze {_degrees(angle)} degrees to the side")
        # Eyes that made up for a turn of the head do so no less than the head moves.
        if min(gaze, head) < 1:
            joints[:, eyes] *= min(gaze, head)
    return AtRest(replace(calm, expression=expression, joints=joints, head_rotation=turn), tuple(moved))


def kept_share(sizes: Float[Tensor, "*n"], limits: tuple[float, float]) -> Float[Tensor, "*n"]:
    """The part of each size that belongs to the person at rest: 1 up to the first limit, 0 from the second on."""
    first, second = limits
    return ((second - sizes) / (second - first)).clamp(0, 1)


def _gaze(eyes: Float[Tensor, "1 e 3"], R_camera_head: Float[Tensor, "1 3 3"]) -> Float[Tensor, ""]:
    """The mean angle of the eyes to straight ahead, in the head or towards the camera, whichever is smaller."""
    turned = matrix_from_axis_angle(eyes)
    angles = [R[..., 2, 2].clamp(-1, 1).arccos().mean() for R in (turned, R_camera_head[:, None] @ turned)]
    return torch.stack(angles).min()


def _degrees(angle: Float[Tensor, ""]) -> int:
    return round(float(angle.rad2deg()))
