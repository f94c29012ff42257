"""Visibility and colours of the surface in the pictures, for the texture of the `paper` schedule."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from mien.tracking.paper_scene import PaperScene
from mien.tracking.paper_terms import Moving, Shown, posed, see


@torch.no_grad()
def sight_of(scene: PaperScene, shown: Shown, moving: Moving) -> Float[Tensor, " f"]:
    """Cosine between each triangle's normal and the direction to the camera; 0 if the picture does not show it."""
    vertices, _ = posed(scene, moving)
    camera = scene.camera(shown.sequence, shown.camera, moving.log_focals)
    visible = see(vertices, scene, camera.resized(*reversed(shown.mask.shape))).face_index
    corners = vertices[scene.mesh.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = cosine_similarity(normals, camera.position - corners.mean(1), dim=1)
    out = torch.zeros(len(corners))
    faces = visible[visible >= 0].long().unique()
    out[faces] = cosine[faces].clamp_min(0)
    return out


@torch.no_grad()
def guess_texture(scene: PaperScene, shown: Shown, moving: Moving, texture: Float[Tensor, "th tw 3"]) -> None:
    """Fill the texture with one skin colour: the median of the pixels that the mesh covers."""
    vertices, _ = posed(scene, moving)
    camera = scene.camera(shown.sequence, shown.camera, moving.log_focals)
    visible = see(vertices, scene, camera.resized(*reversed(shown.mask.shape))).face_index
    used = torch.cat([scene.used, torch.zeros(1)])[visible.long()] > 0
    if used.any():
        texture[:] = shown.image[used].median(0).values


def roughness_gradient(scene: PaperScene, texture: Float[Tensor, "th tw 3"]) -> Float[Tensor, "th tw 3"]:
    """Gradient of the squared differences between neighbouring texels, scaled like the cost of a picture."""
    gradient = torch.zeros_like(texture)
    for axis in (0, 1):
        step = texture.detach().diff(dim=axis)
        size = texture.shape[axis] - 1
        gradient.narrow(axis, 1, size).add_(step)
        gradient.narrow(axis, 0, size).sub_(step)
    return gradient * (2 / scene.settings.texture_roughness**2 / texture.shape[0])
