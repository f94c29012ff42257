"""Mirror images of a face model's triangles on the other side of the head."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mien.face.model import FaceModel

_MIRROR_REACH = 0.75
"""Distance between a triangle's reflected middle and its mirror image's, in square roots of the triangle's area."""
_MIRROR_ALIGNED = 0.5
"""Cosine between a reflected normal and the mirror image's normal from which two triangles face alike."""

_CHUNK = 512


def mirror_triangles(face_model: FaceModel) -> Int[Tensor, " f"]:
    """Return the index of each triangle's mirror image across x = 0 in the template; -1 for triangles without one.

    The mirror image is the triangle nearest to the reflected middle. It belongs to the same region and faces the
    reflected direction. It need not be exact: quads that are split along different diagonals on both sides still match,
    but a triangle whose reflection is far from the mesh has none. A triangle on the midline may be its own image. On a
    symmetric mesh the map is its own inverse.
    """
    template, faces = face_model.template.double().cpu(), face_model.faces.long().cpu()
    middles, areas, normals = triangle_geometry(template, faces)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    reach = _MIRROR_REACH * areas.sqrt()
    images = torch.full((len(faces),), -1, dtype=torch.int64)
    for region in face_model.face_regions.unique().tolist():
        members = (face_model.face_regions.cpu() == region).nonzero()[:, 0]
        for own in members.split(_CHUNK):
            # Without matrix products, which lose the digits that tell neighbours apart.
            distance = torch.cdist(middles[own] * flip, middles[members], compute_mode="donot_use_mm_for_euclid_dist")
            aligned = (normals[own] * flip) @ normals[members].T > _MIRROR_ALIGNED
            nearest, index = distance.masked_fill(~aligned, torch.inf).min(1)
            image = members[index]
            images[own] = torch.where(nearest <= torch.maximum(reach[own], reach[image]), image, -1)
    return images


def triangle_geometry(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, " f"], Float[Tensor, "f 3"]]:
    """Return the middle, the area and the unit normal (zero without an area) of every triangle."""
    a, b, c = vertices[faces.long()].unbind(1)
    cross = torch.linalg.cross(b - a, c - a)
    return (a + b + c) / 3, cross.norm(dim=-1) / 2, normalize(cross, dim=-1, eps=1e-20)
