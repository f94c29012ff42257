"""Positions of the cameras."""

import math

import torch

from mien.camera import Camera, look_at
from mien.synthetic.recipe import SyntheticRecipe

_LARGEST_AZIMUTH = 72.0
"""Largest angle to either side of a ring, in degrees."""
_ELEVATIONS = (0.0, 24.0, -16.0)
"""Elevations of the three rows in degrees above the face; cameras alternate between them."""


def cameras_of(recipe: SyntheticRecipe) -> tuple[Camera, ...]:
    """Return one camera per camera_id, all in one world frame.

    The first is at the world's origin and looks along -z at the head, `recipe.distance` away. The others of a ring look
    at the same point from the same distance. They are spread evenly from one side to the other, in three rows.
    """
    focal = recipe.focal * recipe.width
    K = torch.tensor([[focal, 0, recipe.width / 2], [0, focal, recipe.height / 2], [0, 0, 1.0]])
    front = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmats = [front]
    target = torch.tensor([0.0, 0.0, -recipe.distance])
    for index in range(1, len(recipe.camera_ids)):
        share = (index - 1) / max(len(recipe.camera_ids) - 2, 1)
        azimuth = math.radians(_LARGEST_AZIMUTH * (2 * share - 1))
        elevation = math.radians(_ELEVATIONS[index % len(_ELEVATIONS)])
        away = torch.tensor([
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
            math.cos(azimuth) * math.cos(elevation),
        ])  # fmt: skip
        viewmats.append(look_at(target + recipe.distance * away, target, torch.tensor([0.0, 1.0, 0.0])))
    return tuple(Camera(K, viewmat, recipe.width, recipe.height) for viewmat in viewmats)
