"""Driving that keeps to what was filmed: expressions, gaze and head poses that training never saw are softened."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.baking import as_array
from mien.face.params import FaceParams
from mien.runtime.baked import Filmed
from mien.runtime.filmed import within_filmed_inputs, within_filmed_poses

_FELT = 1e-3
"""Change of a coefficient or of an angle in radians from which a timestep counts as softened."""


def keep_to_filmed(
    face: FaceParams,
    filmed: Filmed,
    neutral: FaceParams,
    expression_bounds: Float[Tensor, "e 2"],
    eye: Float[Tensor, " 3"],
) -> tuple[FaceParams, int]:
    """Return the face softly within what was filmed (`mien.runtime.filmed`), and how many timesteps that changes.

    Args:
        face: The timesteps to limit, of the avatar's person.
        filmed: What training saw of this person.
        neutral: One timestep of this person at rest.
        expression_bounds: `FaceModel.expression_bounds`.
        eye: Position of the camera that will see the avatar, in world space, in metres.
    """
    count = face.expression.shape[1]
    inputs = as_array(torch.cat([face.expression, face.joints.flatten(1)], dim=1))
    rest = as_array(torch.cat([neutral.expression, neutral.joints.flatten(1)], dim=1))[0]
    kept = within_filmed_inputs(filmed, inputs, rest, as_array(expression_bounds))
    rotation, translation = as_array(face.head_rotation), as_array(face.head_translation)
    turned = within_filmed_poses(filmed, rotation, translation, as_array(eye))
    changed = (np.abs(kept - inputs).max(1) > _FELT) | (np.abs(turned - rotation).max(1) > _FELT)
    limited = replace(
        face,
        expression=torch.from_numpy(kept[:, :count].copy()).to(face.expression),
        joints=torch.from_numpy(kept[:, count:].copy()).to(face.joints).reshape(face.joints.shape),
        head_rotation=torch.from_numpy(turned).to(face.head_rotation),
    )
    return limited, int(changed.sum())
