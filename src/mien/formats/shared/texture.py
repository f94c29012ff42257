"""A texture of an avatar's mesh, taken from pictures of its Gaussians on all sides."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from mien import runtime
from mien.camera import Camera, camera_from_fov
from mien.render.camera_paths import turned_camera
from mien.render.mesh import interpolate, rasterize_mesh, sample_picture, vertex_normals
from mien.runtime.posing import SH_C0

VIEWS = tuple((yaw, 0) for yaw in range(0, 360, 30)) + tuple(
    (yaw, pitch) for pitch in (-40, 40) for yaw in range(0, 360, 60)
)
"""Sides that the head is drawn from: degrees to the person's left, and upwards."""
FRONT_VIEWS = ((0, 0), (0, 25), (0, -25), (-30, 0), (30, 0))
"""Sides from which an open mouth and turned eyes show what is hidden at rest."""
_DEPTH_TOLERANCE = 0.0005
"""Depth in metres behind the mesh's nearest surface up to which a texel counts as visible, beside the depth that one
pixel of an inclined surface has. Lids are thin."""
_LEAST_COSINE = 0.15
_LEAST_ALPHA = 0.5
"""Least cosine between the normal and the direction to the camera, and least alpha, with which a texel is taken."""
_BEHIND = 0.025
"""Depth in metres behind a texel up to which the mean depth of what is drawn there may lie. Beyond it, a picture shows
what is behind a thin surface, such as the mouth through the nape."""
_LITTLE = 1e-5
"""Weight of the colour of the nearest Gaussians, which decides where no picture shows the surface."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with texture coordinates."""

    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "u 2"]
    """Texture coordinates, 0..1, v upwards."""
    uv_faces: Int[Tensor, "f 3"]
    """Indices into `uv`."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A pose of the avatar, in which pictures are taken."""

    vertices: Float[Tensor, "v 3"]
    """Vertices of the mesh in the head frame, in metres."""
    gaussians: runtime.Gaussians
    """The Gaussians of the same pose, in the same frame."""
    views: Sequence[tuple[int, int]] = VIEWS
    weight: float = 1.0
    """Weight of these pictures. A small one lets them decide only where no other picture shows the surface."""


@torch.no_grad()
def bake_texture(surface: Surface, shots: Sequence[Shot], size: int) -> Float32[np.ndarray, "s s 3"]:
    """A texture [size, size], 0..1, with its first row at v = 1: the colours of the Gaussians as one sees them outside.

    Each texel is the mean over the views that see it, weighted by how squarely they do. A view that sees through a thin
    surface, such as the faded nape, sees what is behind it, and does not count. Surfaces that no view sees have the
    mean colour of the Gaussians nearest to their triangle in the first pose.
    """
    upwards = surface.uv * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    K = torch.tensor([[float(size), 0, 0], [0, float(size), 0], [0, 0, 1]])
    flat = torch.cat([upwards, torch.ones(len(upwards), 1)], 1)
    layout = rasterize_mesh(flat, surface.uv_faces, Camera(K, torch.eye(4), size, size))
    covered = layout.face_index >= 0
    colors = _LITTLE * _nearest_colors(surface, shots[0])[layout.face_index[covered].long()]
    weights = torch.full((len(colors), 1), _LITTLE)
    for shot in shots:
        points = interpolate(layout, shot.vertices, surface.faces)[covered]
        normals = interpolate(layout, vertex_normals(shot.vertices, surface.faces), surface.faces)[covered]
        for camera in _cameras(shot):
            image, weight = _seen(points, normals, surface, shot, camera)
            colors += shot.weight * weight * image
            weights += shot.weight * weight
    texture = torch.zeros(size, size, 3)
    texture[covered] = (colors / weights).clamp(0, 1)
    return _continued(texture, covered).numpy()


def _cameras(shot: Shot) -> list[Camera]:
    center = (shot.vertices.amin(0) + shot.vertices.amax(0)) / 2
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ (center + torch.tensor([0.0, 0.0, 1.0]))
    front = camera_from_fov(0.4, 1024, 1024, viewmat)
    return [turned_camera(front, center, math.radians(yaw), math.radians(pitch)) for yaw, pitch in shot.views]


def _seen(
    points: Float[Tensor, "p 3"], normals: Float[Tensor, "p 3"], surface: Surface, shot: Shot, camera: Camera,
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 1"]]:  # fmt: skip
    """The colours of points in one picture, and their weights."""
    plain = runtime.Camera(camera.K.numpy(), camera.viewmat.numpy(), camera.width, camera.height)
    image, alpha = map(torch.from_numpy, runtime.render(shot.gaussians, plain, (0.0, 0.0, 0.0)))
    drawn = torch.from_numpy(runtime.render(_with_depths(shot.gaussians, camera), plain, (0.0, 0.0, 0.0))[0])
    depth = rasterize_mesh(shot.vertices, surface.faces, camera).depth.nan_to_num(posinf=1e3)
    pixels, ahead = camera.project(points)
    grid = 2 * pixels / torch.tensor([float(camera.width), float(camera.height)]) - 1
    picture = sample_picture(torch.cat([image, alpha[..., None], drawn[..., :1]], -1), grid, "bilinear")
    nearest = sample_picture(depth[..., None], grid, "nearest")[:, 0]
    towards = torch.nn.functional.normalize(camera.position - points, dim=-1)
    cosine = (torch.nn.functional.normalize(normals, dim=-1) * towards).sum(-1)
    opacity = picture[:, 3]
    pixel = ahead / camera.K[0, 0]
    usable = (
        (ahead <= nearest + _DEPTH_TOLERANCE + pixel / cosine.clamp_min(_LEAST_COSINE))
        & (cosine > _LEAST_COSINE)
        & (opacity > _LEAST_ALPHA)
    )
    usable &= (grid.abs() < 1).all(-1)
    usable &= picture[:, 4] / opacity.clamp_min(_LEAST_ALPHA) < ahead + _BEHIND
    weight = torch.where(usable, cosine**4, torch.zeros_like(cosine))
    return picture[:, :3] / opacity.clamp_min(_LEAST_ALPHA)[:, None], weight[:, None]


def _with_depths(gaussians: runtime.Gaussians, camera: Camera) -> runtime.Gaussians:
    """The same Gaussians with their depths in metres as colours."""
    sh = np.zeros((len(gaussians.means), 1, 3), np.float32)
    depths = camera.project(torch.from_numpy(gaussians.means))[1].numpy()
    sh[:, 0] = (depths[:, None] - 0.5) / SH_C0
    return replace(gaussians, sh=sh)


def _nearest_colors(surface: Surface, shot: Shot) -> Float[Tensor, "f 3"]:
    """For each triangle, the mean colour of the Gaussians nearest to its middle, weighted by their opacities."""
    gaussians, middles = shot.gaussians, shot.vertices[surface.faces].mean(1)
    means, opacities = torch.from_numpy(gaussians.means), torch.from_numpy(gaussians.opacities)
    colors = (0.5 + SH_C0 * torch.from_numpy(gaussians.sh[:, 0])).clamp(0, 1)
    found = []
    for part in middles.split(512):
        near = torch.cdist(part, means).topk(min(8, len(means)), largest=False).indices
        weight = opacities[near].clamp_min(1e-6)[..., None]
        found.append((weight * colors[near]).sum(1) / weight.sum(1))
    return torch.cat(found)


def _continued(texture: Float[Tensor, "s s 3"], covered: Tensor) -> Float[Tensor, "s s 3"]:
    """The texture with the colours at the borders of its pieces continued outwards, so that these do not show."""
    for _ in range(8):
        weight = covered[None, None].float()
        both = torch.cat([texture.permute(2, 0, 1)[None] * weight, weight], 1)
        around = torch.nn.functional.avg_pool2d(both, 3, stride=1, padding=1)
        filled = (around[:, :3] / around[:, 3:].clamp_min(1e-6))[0].permute(1, 2, 0)
        fresh = ~covered & (around[0, 3] > 0)
        texture = torch.where(fresh[..., None], filled, texture)
        covered = covered | fresh
    return texture
