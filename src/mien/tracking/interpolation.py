"""Parameters of frames without a face, interpolated from their neighbours."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.face import FaceParams


def fill_gaps(face: FaceParams, valid: Bool[Tensor, " t"]) -> FaceParams:
    """Parameters of all t timesteps from those of the valid ones: linear between neighbours, constant at the ends.

    The rotation of a head in view is far from pi, so axis-angle vectors interpolate like any other parameter.
    """
    assert len(face) == int(valid.sum())
    known = valid.nonzero()[:, 0].numpy()
    every = np.arange(len(valid))

    def fill(values: Float[Tensor, "v ..."]) -> Float[Tensor, "t ..."]:
        flat = values.flatten(1).numpy()
        filled = [np.interp(every, known, flat[:, column]) for column in range(flat.shape[1])]
        return torch.from_numpy(np.stack(filled, axis=1)).to(values).reshape(-1, *values.shape[1:])

    return replace(
        face,
        expression=fill(face.expression),
        joints=fill(face.joints),
        head_rotation=fill(face.head_rotation),
        head_translation=fill(face.head_translation),
    )
