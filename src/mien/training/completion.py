"""Colours of triangles that no training picture shows. A simple stand-in: mirrored, else nearest."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face import FaceModel

_MIRROR_DISTANCE = 0.006
"""Distance in metres up to which a seen triangle counts as a mirror image."""
_ROWS = 512
"""Triangles whose distances are in memory at a time."""


def complete_colors(
    face_model: FaceModel,
    template_vertices: Float[Tensor, "v 3"],
    seen: Float[Tensor, " f"],
    colors: Float[Tensor, "f 3"],
) -> Float[Tensor, "f 3"]:
    """A colour for every triangle: `colors` where `seen` is 1, blended with a guess below.

    The guess is the colour of the mirror image if that is seen, and else of the nearest seen triangle.

    Args:
        face_model: The face model.
        template_vertices: Vertices of the person's neutral head, in the head frame, in metres.
        seen: Confidence of each triangle, 0..1.
        colors: Mean colours in the pictures, 0..1.
    """
    centres = template_vertices[face_model.faces.long()].mean(1)
    known, unsure = (seen > 0.5).nonzero()[:, 0], (seen < 1).nonzero()[:, 0]
    out = colors.clone()
    if len(known) == 0:
        return out
    mirror = centres.new_tensor([-1.0, 1.0, 1.0])
    for rows in unsure.split(_ROWS):
        own = centres[rows]
        apart, image = torch.cdist(own * mirror, centres[known]).min(1)
        nearest = torch.cdist(own, centres[known]).argmin(1)
        guess = colors[known[torch.where(apart < _MIRROR_DISTANCE, image, nearest)]]
        out[rows] = torch.lerp(guess, colors[rows], seen[rows, None])
    return out
