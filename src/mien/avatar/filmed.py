"""What training saw of a face: the range of expressions and of head poses, which driving keeps to."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.ops.expression_changes import expression_inputs
from mien.face.params import FaceParams
from mien.runtime.baked import Filmed
from mien.runtime.filmed import head_angles

_FILMED_LEAST_SPREAD = 0.3  # spread that every direction of expressions has at least, relative to the largest


@torch.no_grad()
def measure_filmed(face: FaceParams, neutral: FaceParams, eyes: Float[Tensor, "b 3"]) -> Filmed:
    """The range of some training frames.

    Args:
        face: Face parameters of each frame.
        neutral: One timestep: the person at rest.
        eyes: Position of the camera of each frame in world space, in metres.
    """
    inputs = expression_inputs(face.detach()).double().cpu()
    offsets = inputs - expression_inputs(neutral.detach())[0].double().cpu()
    variances, vectors = torch.linalg.eigh(offsets.T @ offsets / len(offsets))
    least = max(_FILMED_LEAST_SPREAD**2 * float(variances[-1]), 1e-6)
    directions = vectors / (variances.clamp_min(0) + least).sqrt()
    poses = (face.head_rotation, face.head_translation, eyes)
    angles = head_angles(*(tensor.detach().double().cpu().numpy() for tensor in poses))
    return Filmed(
        lowest=inputs.amin(0).float().numpy(),
        highest=inputs.amax(0).float().numpy(),
        directions=directions.float().numpy(),
        reach=(offsets @ directions).norm(dim=1).amax(0, keepdim=True).float().numpy(),
        head_angles=np.stack([angles.min(0), angles.max(0)], axis=1).astype(np.float32),
    )
