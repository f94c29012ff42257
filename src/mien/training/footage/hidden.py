"""Which triangles inside a head a picture cannot show: eyeballs behind lids, teeth and tongue behind lips."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from mien.camera import Camera
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.render.mesh import rasterize_mesh

_HIDDEN_SIZE = 256  # longer side in pixels of the depth pictures of skin, lids and lips
_HIDDEN_SLACK = 1
"""Pixels of such a picture by which gaps between lids and lips are wider than those of the mesh, because the tracking
is not exact. Measured: 0 blurs irises and takes highlights from the eyes of d3 (log, 11-26)."""

_SAMPLES = ((1, 1, 1), (4, 1, 1), (1, 4, 1), (1, 1, 4), (1, 4, 4), (4, 1, 4), (4, 4, 1))
"""Points of a triangle that are looked for, as weights of its corners before they are normalised."""


def inside_triangles(face_model: FaceModel) -> Bool[Tensor, " f"]:
    """Return which triangles are inside a head: eyeballs, irises, mouth, teeth and tongue."""
    parts = head_parts(face_model)
    return parts.interior | parts.eyes[0] | parts.eyes[1]


@torch.no_grad()
def hidden_triangles(
    vertices: Float[Tensor, "v 3"], face_model: FaceModel, inside: Bool[Tensor, " f"], camera: Camera
) -> Bool[Tensor, " f"]:
    """Return which triangles inside a head no part of a picture shows, because the rest of the mesh is in front.

    A triangle counts as seen if one of seven points of it is nearer than everything outside, in its own pixel or in one
    beside it.
    Vertices are in world space, in metres. Triangles that are not `inside` the head are never returned.
    """
    scale = _HIDDEN_SIZE / max(camera.width, camera.height)
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    outside = rasterize_mesh(vertices, face_model.faces[~inside], small).depth.nan_to_num(posinf=1e3)
    furthest = max_pool2d(outside[None], 2 * _HIDDEN_SLACK + 1, 1, _HIDDEN_SLACK)[0]
    weights = vertices.new_tensor(_SAMPLES)
    points = torch.einsum("sk,fkc->fsc", weights / weights.sum(1, keepdim=True), vertices[face_model.faces[inside]])
    pixels, depth = small.project(points.reshape(-1, 3))
    column, row = pixels.nan_to_num(nan=-1.0, posinf=-1.0, neginf=-1.0).floor().long().unbind(-1)
    within = (depth > 0) & (column >= 0) & (column < small.width) & (row >= 0) & (row < small.height)
    in_front = furthest[row.clamp(0, small.height - 1), column.clamp(0, small.width - 1)]
    shown = within & (depth < in_front)
    hidden = torch.zeros_like(inside)
    hidden[inside] = ~shown.view(points.shape[:2]).any(1)
    return hidden
