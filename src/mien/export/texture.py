"""A texture of an avatar's mesh, taken from pictures of its Gaussians on all sides."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from mien import runtime
from mien.camera import Camera, camera_from_fov
from mien.render.camera_paths import turned_camera
from mien.render.mesh import interpolate, rasterize_mesh, vertex_normals
from mien.runtime.posing import SH_C0
from mien.training.footage import sample_picture

VIEWS = tuple((yaw, 0) for yaw in range(0, 360, 30)) + tuple(
    (yaw, pitch) for pitch in (-40, 40) for yaw in range(0, 360, 60)
)
"""Sides that the head is drawn from: degrees to the person's left, and upwards."""
FRONT_VIEWS = ((0, 0), (0, 25), (0, -25), (-30, 0), (30, 0))
"""Sides from which an open mouth and turned eyes show what is hidden at rest."""
_FIELD, _DISTANCE, _SIZE = 0.4, 1.0, 1024
"""Field of view in radians, distance in metres and side in pixels of these pictures."""
_DEPTH_TOLERANCE = 0.0005
"""Depth in metres behind the mesh's nearest surface up to which a texel counts as visible, beside the depth that one
pixel of an inclined surface has. Lids are thin."""
_LEAST_COSINE = 0.15
_LEAST_ALPHA = 0.5
"""Least cosine between the normal and the direction to the camera, and least alpha, with which a texel is taken."""
_LITTLE = 1e-5
"""Weight of the colour of the nearest Gaussians, which decides where no picture shows the surface."""
_NEAREST, _CHUNK = 8, 512
_BARE = 0.01
"""Distance in metres to the nearest Gaussian beyond which a triangle has none of its own."""
_ABOVE = 0.6
"""Cosine between the normal and the way to the nearest Gaussian from which on that Gaussian stands above a triangle."""
_NEAREST_SEEN, _TURNED_AWAY = 24, 2.0
"""Number of seen triangles whose colours such a triangle takes, and how much farther those count that face away."""
_SURELY = 1e-3
"""Weight from which on a texel was seen."""
_ROUNDS = 8
"""Texels by which the texture is continued over the borders of its pieces, so that they do not show."""


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

    Each texel is the mean over the views that see it, weighted by how squarely they do. Surfaces that no view sees
    have the mean colour of the Gaussians nearest to their triangle in the first pose. Where none is near, as below the
    cut at the neck, they have the colours of the nearest surfaces that were seen and face the same way, so that the
    nape continues the skin above it and not the inside of the mouth.

    Args:
        surface: The mesh.
        shots: The poses in which it is drawn.
        size: Side of the texture in texels.
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
    colors = (colors / weights).clamp(0, 1)
    bare = _BareFaces(surface, shots[0], layout.face_index[covered].long())
    texture = torch.zeros(size, size, 3)
    texture[covered] = bare.painted(colors, weights[:, 0] > _SURELY)
    return _continued(texture, covered).numpy()


def _cameras(shot: Shot) -> list[Camera]:
    center = (shot.vertices.amin(0) + shot.vertices.amax(0)) / 2
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ (center + torch.tensor([0.0, 0.0, _DISTANCE]))
    front = camera_from_fov(_FIELD, _SIZE, _SIZE, viewmat)
    return [turned_camera(front, center, math.radians(yaw), math.radians(pitch)) for yaw, pitch in shot.views]


def _seen(
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    surface: Surface,
    shot: Shot,
    camera: Camera,
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 1"]]:
    """The colours of points in one picture, and their weights."""
    plain = runtime.Camera(camera.K.numpy(), camera.viewmat.numpy(), camera.width, camera.height)
    image, alpha = map(torch.from_numpy, runtime.render(shot.gaussians, plain, (0.0, 0.0, 0.0)))
    depth = rasterize_mesh(shot.vertices, surface.faces, camera).depth.nan_to_num(posinf=1e3)
    pixels, ahead = camera.project(points)
    grid = 2 * pixels / torch.tensor([float(camera.width), float(camera.height)]) - 1
    picture = sample_picture(torch.cat([image, alpha[..., None]], -1), grid, "bilinear")
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
    weight = torch.where(usable, cosine**4, torch.zeros_like(cosine))
    return picture[:, :3] / opacity.clamp_min(_LEAST_ALPHA)[:, None], weight[:, None]


def _nearest_colors(surface: Surface, shot: Shot) -> Float[Tensor, "f 3"]:
    """For each triangle, the mean colour of the Gaussians nearest to its middle, weighted by their opacities."""
    gaussians, middles = shot.gaussians, shot.vertices[surface.faces].mean(1)
    means, opacities = torch.from_numpy(gaussians.means), torch.from_numpy(gaussians.opacities)
    colors = (0.5 + SH_C0 * torch.from_numpy(gaussians.sh[:, 0])).clamp(0, 1)
    found = []
    for part in middles.split(_CHUNK):
        near = torch.cdist(part, means).topk(min(_NEAREST, len(means)), largest=False).indices
        weight = opacities[near].clamp_min(1e-6)[..., None]
        found.append((weight * colors[near]).sum(1) / weight.sum(1))
    return torch.cat(found)


class _BareFaces:
    """The triangles that have no Gaussian near, and the triangles of the texels."""

    def __init__(self, surface: Surface, shot: Shot, owner: Int[Tensor, " p"]) -> None:
        self._owner, self._count = owner, len(surface.faces)
        self._middles = shot.vertices[surface.faces].mean(1)
        normals = vertex_normals(shot.vertices, surface.faces)[surface.faces].mean(1)
        self._normals = torch.nn.functional.normalize(normals, dim=-1)
        means = torch.from_numpy(shot.gaussians.means)
        nearest = torch.cat([torch.cdist(part, means).argmin(1) for part in self._middles.split(_CHUNK)])
        apart = means[nearest] - self._middles
        distance = apart.norm(dim=-1)
        # What stands out from the mesh, such as hair, has its Gaussians straight above it.
        above = (apart * self._normals).sum(-1) > _ABOVE * distance
        self._bare = (distance > _BARE) & ~above

    def painted(self, colors: Float[Tensor, "p 3"], seen: Bool[Tensor, " p"]) -> Float[Tensor, "p 3"]:
        """The colours of texels, with those of bare triangles replaced by what is seen around.

        Pictures of bare triangles show what is behind them, such as the mouth through the nape.
        """
        seen = seen & ~self._bare[self._owner]
        counts = torch.zeros(self._count).index_add(0, self._owner[seen], torch.ones(int(seen.sum())))
        sums = torch.zeros(self._count, 3).index_add(0, self._owner[seen], colors[seen])
        known = (counts > 0).nonzero()[:, 0]
        wanted = self._bare.nonzero()[:, 0]
        if len(known) == 0 or len(wanted) == 0:
            return colors
        means, filled = sums[known] / counts[known, None], torch.zeros(self._count, 3)
        for part in wanted.split(_CHUNK):
            facing = self._normals[part] @ self._normals[known].T
            distance = torch.cdist(self._middles[part], self._middles[known]) * (1 + _TURNED_AWAY * (1 - facing))
            near = distance.topk(min(_NEAREST_SEEN, len(known)), largest=False)
            weight = 1 / near.values.clamp_min(1e-4)[..., None]
            filled[part] = (weight * means[near.indices]).sum(1) / weight.sum(1)
        replaced = torch.zeros(self._count, dtype=torch.bool)
        replaced[wanted] = True
        return torch.where(replaced[self._owner][:, None], filled[self._owner], colors)


def _continued(texture: Float[Tensor, "s s 3"], covered: Tensor) -> Float[Tensor, "s s 3"]:
    """The texture with the colours at the borders of its pieces continued outwards."""
    for _ in range(_ROUNDS):
        weight = covered[None, None].float()
        both = torch.cat([texture.permute(2, 0, 1)[None] * weight, weight], 1)
        around = torch.nn.functional.avg_pool2d(both, 3, stride=1, padding=1)
        filled = (around[:, :3] / around[:, 3:].clamp_min(1e-6))[0].permute(1, 2, 0)
        fresh = ~covered & (around[0, 3] > 0)
        texture = torch.where(fresh[..., None], filled, texture)
        covered = covered | fresh
    return texture
