"""Gradients of pictures of meshes with respect to the mesh: through what a pixel shows, and through silhouettes.

Made of operations that can be used alone (`image_points`, `differentiable_fragments`, `interpolate`, `sample_texture`,
`antialias`) and of one that does all of them with light and a robust loss in one pass (`mesh_loss`). Each has a twin in
plain PyTorch in `mien.render.mesh_reference`. One thread, GIL released, the same to the bit in every run.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.render.mesh import MeshFragments
from mien.render.mesh_functions import attach_barycentrics, blend_silhouettes, compare_picture


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """The edges along which a mesh may have a silhouette. All int32."""

    vertices: Int[Tensor, "e 2"]
    faces: Int[Tensor, "e 2"]
    """Triangles on both sides; the second is -1 at a border."""
    opposite: Int[Tensor, " e"]
    """The first triangle's third vertex: on which side of a silhouette the mesh lies."""


@dataclass(frozen=True, eq=False)
class LitMesh:
    """What of a textured mesh stays the same from picture to picture."""

    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "f 3 2"]
    """Of every triangle's corners; 0..1, v upwards."""
    face_weights: Float[Tensor, " f"]
    """How far a triangle's pixels count; 0 for one that only hides what is behind it."""
    edges: MeshEdges
    """Those whose silhouettes are drawn to where colours change."""


def mesh_edges(faces: Int[Tensor, "f 3"], used: Tensor | None = None) -> MeshEdges:
    """All edges of a mesh; with `used` [f], only those between triangles that are all used.

    An edge of more than two triangles counts for each two of them that follow one another.
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
    """World-space points as (x, y) pixels times depth, and depth in metres. Differentiable, in the camera as well."""
    return (vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T


def differentiable_fragments(
    fragments: MeshFragments, points: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> MeshFragments:
    """The same fragments with barycentrics that are differentiable in the image points they were drawn from.

    What is seen stays as it is, and so does depth. A barycentric that was clamped at 0 does not move.
    """
    barycentric = attach_barycentrics(fragments.barycentric, points, fragments.face_index, fragments.depth, faces)
    return replace(fragments, barycentric=barycentric)


def antialias(
    image: Float[Tensor, "h w c"],
    fragments: MeshFragments,
    points: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    edges: MeshEdges,
) -> Float[Tensor, "h w c"]:
    """A picture blended across silhouettes, which makes it differentiable in where they are.

    Where a silhouette passes between the centres of two neighbouring pixels, the one that it covers by less or more
    than half gets the share of the other's colour that it should have (as in Laine et al. 2020, section 3.6). Here
    silhouettes are found by walking the mesh's own edges: at a contour the triangles that pixels see are slivers, whose
    edges miss most crossings. An edge counts where the outer pixel sees something farther away, and of several
    crossings between two pixels the outermost one does.
    """
    fixed = (fragments.face_index, fragments.barycentric.detach(), fragments.depth, faces)
    return blend_silhouettes(image, points, *fixed, edges.vertices, edges.faces, edges.opposite)


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
    """How far the lit, textured mesh is from a picture; differentiable in points, normals, texture and light.

    The picture is albedo times SH light, antialiased along `mesh.edges`, before the target itself: only what the mesh
    covers can differ. The loss is the mean over pixels, weighted by mask and triangle, of
    sqrt(|difference|^2 + epsilon^2) - epsilon over the three colours together (Charbonnier), which is L1's pull on
    outliers without its kink.

    Args:
        fragments: The mesh as it is seen (`rasterize_mesh`); float32.
        points: `image_points` of its vertices.
        normals: Of its vertices, of any length.
        mesh: Its triangles, texture coordinates, weights and edges.
        texture: Albedo; rows from v = 1 down.
        light: SH coefficients over the normals' directions, as `mien.render.mesh.shade`.
        target: The picture, how far each of its pixels counts, and epsilon.
        picture: If given, what was drawn is written there.
    """
    constants = (
        fragments.face_index, fragments.barycentric.detach(), fragments.depth, mesh.faces, mesh.edges.vertices,
        mesh.edges.faces, mesh.edges.opposite, mesh.uv, mesh.face_weights,
    )  # fmt: skip
    return compare_picture(points, normals, texture, light, constants, target, picture)
