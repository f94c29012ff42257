"""Trust in the landmarks of several cameras that see a head at once, by the head's direction.

In pictures from the side a detector guesses the far half of the face, and its landmarks of the near half change with
the view. A single camera is fully trusted, because the effect of turns on landmarks was measured for that case
(`mien.tracking.detector_response`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.rotation import matrix_from_axis_angle
from mien.tracking.views import CameraBatch, Views

_SIDEWAYS = 0.3
"""Angle between the direction of the face and the camera at which a picture counts half, in radians."""


def trust_of(views: Views, state: Float[Tensor, "v p"], cameras: CameraBatch) -> Float[Tensor, " n"]:
    """Weight of each picture's landmarks, 0..1. It is 1 for the most frontal picture of each timestep.

    Args:
        views: The pictures.
        state: Parameters of the timesteps. The first six are the head's axis-angle rotation and translation (metres).
        cameras: The cameras, in the frame of the state.
    """
    ahead = matrix_from_axis_angle(state[:, :3])[views.row, :, 2]
    sight = cameras.centres[views.camera] - state[views.row, 3:6]
    angle = ((ahead * sight).sum(-1) / sight.norm(dim=-1)).clamp(-1, 1).acos()
    trust = 1 / (1 + (angle / _SIDEWAYS) ** 4)
    best = torch.zeros_like(state[:, 0]).scatter_reduce(0, views.row, trust, "amax")
    return trust / best[views.row]
