"""Gradients of pictures of meshes with respect to the mesh: through the visible surface and through silhouettes.

`mesh_loss` draws a lit, textured mesh and compares it with a picture, with all gradients in a single pass. It runs on
one thread, releases the GIL, and is deterministic to the bit.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.camera import Camera
from mien.render.mesh import MeshFragments


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """The edges along which a mesh may have a silhouette. All int32."""

    vertices: Int[Tensor, "e 2"]
    faces: Int[Tensor, "e 2"]
    """Triangles on both sides of each edge. The second is -1 at a border."""
    opposite: Int[Tensor, " e"]
    """Third vertex of the first triangle, which shows on which side of a silhouette the mesh is."""


@dataclass(frozen=True, eq=False)
class LitMesh:
    """Constants of a textured mesh, which are the same for all pictures."""

    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "f 3 2"]
    """Texture coordinates of every triangle's corners; 0..1, v upwards."""
    face_weights: Float[Tensor, " f"]
    """Weight of each triangle's pixels. It is 0 for a triangle that only hides what is behind it."""
    edges: MeshEdges
    """Edges at which silhouettes are antialiased, so that the loss can move them."""


def mesh_edges(faces: Int[Tensor, "f 3"], used: Tensor | None = None) -> MeshEdges:
    """All edges of a mesh. With `used` [f], only those between used triangles.

    An edge of more than two triangles is listed once for each pair of consecutive triangles.
    """
    table = faces.cpu().numpy()
    corners = np.concatenate([table[:, [0, 1, 2]], table[:, [1, 2, 0]], table[:, [2, 0, 1]]])
    face = np.tile(np.arange(len(table)), 3)
    ends = np.sort(corners[:, :2], axis=1)
    order = np.lexsort((face, ends[:, 1], ends[:, 0]))
    ends, face, opposite = ends[order], face[order], corners[order, 2]
    first = np.ones(len(ends), bool)
    first[1:] = (ends[1:] != ends[:-1]).any(1)
    last = np.append(first[1:], True)
    # Every row but the last of its group pairs with the next one; a group of one is a border.
    kept = ~last | (first & last)
    second = np.where(last, -1, np.append(face[1:], -1))
    if used is not None:
        is_used = np.append(used.cpu().numpy().astype(bool), True)
        kept &= is_used[face] & is_used[second]
    pick = [torch.from_numpy(a[kept].astype(np.int32)) for a in (ends, np.stack([face, second], 1), opposite)]
    return MeshEdges(pick[0], pick[1], pick[2])


def image_points(camera: Camera, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3"]:
    """World-space points as (x, y) in pixels times depth, and depth in metres. Differentiable, also in the camera."""
    return (vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T


def mesh_loss(
    fragments: MeshFragments,
    points: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    mesh: LitMesh,
    texture: Float[Tensor, "th tw 3"],
    light: Float[Tensor, "9 3"],
    target: tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"], float],
    picture: Float[Tensor, "h w 3"] | None = None,
) -> Float[Tensor, ""]:
    """Difference between the lit, textured mesh and a picture, differentiable in points, normals, texture and light.

    The drawn picture is albedo times light (spherical harmonics), with the target as background, so only pixels that
    the mesh covers can differ. It is blended across silhouettes, which makes it differentiable in their positions: if
    one passes between the centres of two neighbouring pixels, the pixel that it crosses gets the share of the other's
    colour that it should have (as in Laine et al. 2020, section 3.6). Silhouettes are found by walking `mesh.edges`,
    because the triangles visible at a contour are slivers, and their edges miss most crossings. An edge counts if the
    outer pixel shows something farther away. Of several crossings between two pixels only the outermost counts.

    The loss is the mean over pixels, weighted by mask and
    triangle, of sqrt(|difference|^2 + epsilon^2) - epsilon over the three colours together (Charbonnier). It pulls on
    outliers like L1 but has no kink.

    Args:
        fragments: The visible fragments of the mesh (`rasterize_mesh`), float32.
        points: `image_points` of the vertices.
        normals: Normals of the vertices, of any length.
        mesh: Triangles, texture coordinates, weights and edges of the mesh.
        texture: Albedo, with rows from v = 1 down.
        light: Spherical harmonics coefficients over the normals' directions, as in `mien.render.mesh.shade`.
        target: The picture, the weight of each of its pixels, and epsilon.
        picture: If given, receives the drawn picture.
    """
    constants = (
        fragments.face_index, fragments.barycentric.detach(), fragments.depth, mesh.faces, mesh.edges.vertices,
        mesh.edges.faces, mesh.edges.opposite, mesh.uv, mesh.face_weights,
    )  # fmt: skip
    inputs = (points, normals, texture, light, constants, target, picture)
    return _MeshLoss.apply(*inputs)  # pyright: ignore[reportReturnType]


class _MeshLoss(torch.autograd.Function):
    """`mesh_loss`. The forward pass computes the value and all gradients at once and keeps them for `backward`."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, normals: Tensor, texture: Tensor, light: Tensor, mesh: tuple, target: tuple,
        picture: Tensor | None,
    ):  # fmt: skip
        tensors = [tensor.detach().contiguous() for tensor in (points, normals, texture, light)]
        face_index, barycentric, depth, faces, edge_vertices, edge_faces, opposite, uv, face_weights = mesh
        grad_points = torch.zeros(points.shape, dtype=torch.float64)
        grad_normals, grad_texture = torch.zeros(normals.shape), torch.zeros(texture.shape)
        grad_light = torch.zeros(9, 3, dtype=torch.float64)
        total, weight = _native.mesh_loss(
            _native.Fragments(face_index, barycentric, depth),
            tensors[0],
            faces,
            _native.MeshEdges(edge_vertices, edge_faces, opposite),
            _native.LitSurface(tensors[1], uv, face_weights, tensors[2], tensors[3]),
            _native.LossTarget(*target),
            picture,
            _native.LossGradients(grad_points, grad_normals, grad_texture, grad_light),
        )
        weight = max(weight, 1.0)
        ctx.weight = weight
        ctx.save_for_backward(grad_points.float(), grad_normals, grad_texture, grad_light.float())
        return points.new_tensor(total / weight)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        scale = float(grad) / ctx.weight
        return *(saved * scale for saved in ctx.saved_tensors), None, None, None
