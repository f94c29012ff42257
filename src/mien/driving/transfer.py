"""The transfer of one person's motion to another person's avatar, relative to each one's face at rest.

Expressions, gaze and head poses that training never saw are softened (`keep_to_filmed`).
"""

from collections import Counter
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.baking import as_array
from mien.driving.expression_map import fit_expression_map
from mien.driving.motion import ARKIT_NAMES, Motion
from mien.errors import UserError
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.torso import TorsoPose, has_torso, still_torso, torso_pose, with_torso
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.baked import Filmed
from mien.runtime.filmed import within_filmed_inputs, within_filmed_poses
from mien.runtime.named import within_lids


def drive(
    driver: FaceParams,
    driver_neutral: FaceParams,
    avatar_neutral: FaceParams,
    expression_bounds: Float[Tensor, "e 2"] | None = None,
    with_head_pose: bool = True,
    who: str = "the driver",
) -> FaceParams:
    """Face parameters that make an avatar follow the driver. Its own identity and offsets stay.

    Expression coefficients are added as differences from the neutral of each person, and clamped to the bounds. Joints,
    head rotation and translation transfer the driver's motion relative to the driver's neutral frame to the avatar's
    neutral frame. A nod therefore stays a nod even if the two people were filmed from different sides.

    Each neutral is one timestep (see `neutral_of`), and the bounds are `FaceModel.expression_bounds`. Without the head
    pose, the head stays at the avatar's neutral. `who` is what messages call the driver, such as its file.
    """
    for name in ("expression", "joints"):
        theirs, ours = getattr(driver, name).shape[1:], getattr(avatar_neutral, name).shape[1:]
        if theirs != ours:
            shown = ["x".join(map(str, shape)) for shape in (theirs, ours)]
            raise UserError(
                f"{who} has {shown[0]} {name} parameters and the avatar has {shown[1]}, so they were tracked "
                "with different face models; track the driver with the avatar's face model"
            )
    expression = avatar_neutral.expression + driver.expression - driver_neutral.expression
    if expression_bounds is not None:
        expression = expression.clamp(expression_bounds[:, 0], expression_bounds[:, 1])
    driven = replace(
        avatar_neutral,
        expression=expression,
        joints=_relative_rotation(driver.joints, driver_neutral.joints, avatar_neutral.joints),
        head_rotation=avatar_neutral.head_rotation.expand(len(driver), -1),
        head_translation=avatar_neutral.head_translation.expand(len(driver), -1),
    )
    if not with_head_pose:
        return driven
    there = matrix_from_axis_angle(driver_neutral.head_rotation)
    here = matrix_from_axis_angle(avatar_neutral.head_rotation)
    moved = (driver.head_translation - driver_neutral.head_translation) @ there[0]
    return replace(
        driven,
        head_rotation=_relative_rotation(
            driver.head_rotation, driver_neutral.head_rotation, avatar_neutral.head_rotation
        ),
        head_translation=avatar_neutral.head_translation + moved @ here[0].T,
    )


def _relative_rotation(
    driver: Float[Tensor, "b *j 3"], driver_neutral: Float[Tensor, "1 *j 3"], avatar_neutral: Float[Tensor, "1 *j 3"]
) -> Float[Tensor, "b *j 3"]:
    """Axis-angle vectors of the avatar's neutral rotation times the driver's rotation relative to its neutral."""
    motion = matrix_from_axis_angle(driver_neutral).transpose(-1, -2) @ matrix_from_axis_angle(driver)
    return axis_angle_from_matrix(matrix_from_axis_angle(avatar_neutral) @ motion)


Torso = Literal["still", "driver", "head"]
"""What the torso of an avatar does: it stands still, follows the driver's torso, or moves with the head."""


def place_torso(
    model: FaceModel,
    driven: FaceParams,
    person: FaceParams,
    torso: Torso = "still",
    driver: tuple[FaceParams, FaceParams] | None = None,
) -> FaceParams:
    """Return driven faces with their torso in its place; `person` is the avatar's person at rest, one timestep.

    `driver` are the driver's faces and its neutral, of the same face model. A recording knows no torso, so a torso that
    follows it moves with the head. Faces of a model without a torso come back as they are.
    """
    if not has_torso(model):
        return driven
    if torso == "head" or (torso == "driver" and driver is None):
        poses = {name: getattr(driven, name) for name in ("head_rotation", "head_translation")}
        return with_torso(model, driven, torso_pose(model, replace(person[[0] * len(driven)], **poses)))
    if torso == "still" or driver is None:
        return still_torso(model, driven, person)
    rest, (now, calm) = torso_pose(model, person), (torso_pose(model, one) for one in driver)
    there, here = (matrix_from_axis_angle(one.head_rotation)[0] for one in (driver[1], person))
    moved = (now.translation - calm.translation) @ there @ here.T
    return with_torso(
        model,
        driven,
        TorsoPose(_relative_rotation(now.rotation, calm.rotation, rest.rotation), rest.translation + moved),
    )


def face_of_motion(motion: Motion, model: FaceModel) -> tuple[FaceParams, FaceParams]:
    """The face parameters, for a face model, of a motion that another program recorded, and the driver at rest.

    Coefficients go to the expressions of the same names, gaze goes to the eye joints, within what the lids can follow
    (`within_lids`). At rest, which is one timestep, all coefficients are zero, as in ARKit and MediaPipe, and the head
    has its median pose. A model without ARKit's names gets the motion of the default model by `fit_expression_map`.
    """
    known = [(ours, ARKIT_NAMES.index(name)) for ours, name in enumerate(model.expression_names) if name in ARKIT_NAMES]
    if not known:
        guide = load_face_model()
        face, rest = face_of_motion(motion, guide)
        transferred = fit_expression_map(guide, model)
        return transferred(face), transferred(rest)
    face, coefficients = model.neutral(len(motion)), torch.from_numpy(motion.coefficients)
    expression, joints = face.expression.clone(), face.joints.clone()
    for ours, theirs in known:
        expression[:, ours] = coefficients[:, theirs]
    for side, name in enumerate(("left_eye", "right_eye")):
        if name in model.free_joint_names:
            joints[:, model.free_joint_names.index(name)] = torch.from_numpy(within_lids(motion.eyes[:, side]))
    rotation, translation = torch.from_numpy(motion.head_rotation), torch.from_numpy(motion.head_translation)
    rest = replace(
        model.neutral(),
        head_rotation=rotation.median(0, keepdim=True).values,
        head_translation=translation.median(0, keepdim=True).values,
    )
    return replace(
        face, expression=expression, joints=joints, head_rotation=rotation, head_translation=translation
    ), rest


def keep_to_filmed(
    face: FaceParams,
    filmed: Filmed,
    neutral: FaceParams,
    model: FaceModel,
    eye: Float[Tensor, " 3"],
) -> tuple[FaceParams, int, list[str]]:
    """Return the face softly within what training saw of this person, how many timesteps that changes, and what of it.

    `neutral` is one timestep of this person at rest, and `eye` the position in metres of the camera that will see the
    avatar, in world space. What changes is named by expression or joint, or as `head`, the most frequent first.
    """
    count = face.expression.shape[1]
    inputs = as_array(torch.cat([face.expression, face.joints.flatten(1)], dim=1))
    rest = as_array(torch.cat([neutral.expression, neutral.joints.flatten(1)], dim=1))[0]
    kept = within_filmed_inputs(filmed, inputs, rest, as_array(model.expression_bounds), model.expression_names)
    rotation, translation = as_array(face.head_rotation), as_array(face.head_translation)
    turned = within_filmed_poses(filmed, rotation, translation, as_array(eye))
    # Smaller changes of a coefficient, or of an angle in radians, are not seen.
    names = [*model.expression_names, *(name for name in model.free_joint_names for _ in range(3)), *["head"] * 3]
    beyond = np.abs(np.concatenate([kept - inputs, turned - rotation], axis=1)) > 1e-3
    often = Counter({name: 0 for name in names})
    for name, times in zip(names, beyond.sum(0).tolist(), strict=True):
        often[name] = max(often[name], times)
    limited = replace(
        face,
        expression=torch.from_numpy(kept[:, :count].copy()).to(face.expression),
        joints=torch.from_numpy(kept[:, count:].copy()).to(face.joints).reshape(face.joints.shape),
        head_rotation=torch.from_numpy(turned).to(face.head_rotation),
    )
    return limited, int(beyond.any(1).sum()), [name for name, times in often.most_common() if times]
