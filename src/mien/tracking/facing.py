"""Which of the cameras that see a head at once to believe about its landmarks: those that it faces.

In pictures from the side a detector guesses the far half of the face, and what it makes of the near one changes with
the view. A single camera is believed as it is: what turns do to landmarks there was measured
(`mien.tracking.detector_response`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.rotation import matrix_from_axis_angle
from mien.tracking.views import CameraBatch, Views

_SIDEWAYS = 0.3
"""Radians between the way the face looks and the camera at which a picture counts half."""


def trust_of(views: Views, state: Float[Tensor, "v p"], cameras: CameraBatch) -> Float[Tensor, " n"]:
    """How much each picture's landmarks count, 0..1; 1 in the picture of each timestep that sees the face best.

    Args:
        views: The pictures.
        state: Of the timesteps: rotation vectors (radians) and translations (metres) of the head first.
        cameras: In the frame of the state.
    """
    ahead = matrix_from_axis_angle(state[:, :3])[views.row, :, 2]
    sight = cameras.centres[views.camera] - state[views.row, 3:6]
    angle = ((ahead * sight).sum(-1) / sight.norm(dim=-1)).clamp(-1, 1).acos()
    trust = 1 / (1 + (angle / _SIDEWAYS) ** 4)
    best = torch.zeros_like(state[:, 0]).scatter_reduce(0, views.row, trust, "amax")
    return trust / best[views.row]
