"""Frames of triangles, and Gaussians that follow them (GaussianAvatars, CVPR 2024, section 3.2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.weak import WeakIdKeyDictionary

from mien import _native
from mien.arrays import native, recycled, recycled_like, unpacked
from mien.rotation import multiply_quaternions, quaternion_from_matrix

_ELLIPSE_WIDENING = 2.0
"""Scales of Gaussians that cover a triangle, in its plane, in its standard deviations. Chosen instead of 1.5 (with the
true tracking, 0.2 dB less in front and 0.7 at 90 degrees, 0.3 dB more behind and 0.5 from above; 11-23)."""
_ELLIPSE_FLATNESS = 0.05  # their scale along the normal, in units of the triangle

DEGENERATE_LENGTH = 1e-7
"""Shortest first edge or height of a triangle that has a frame of its own, in metres."""


@dataclass(frozen=True, eq=False)
class TriangleFrames:
    """Position, orientation and size of triangles: world = k R local + T."""

    R: Float[Tensor, "*b f 3 3"]
    """Rotations. The columns are the directions along the first edge, along the normal, and their cross product."""
    T: Float[Tensor, "*b f 3"]
    """Centroids, in metres."""
    k: Float[Tensor, "*b f"]
    """Means of the first edge's length and the height over it, in metres, positive."""


def triangle_frames(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> TriangleFrames:
    """The frame of every triangle, differentiable in `vertices`.

    A degenerate triangle (see `DEGENERATE_LENGTH`) gets a fixed rotation and the size 1e-7 m, both without gradient, so
    that everything stays finite.
    """
    v0, v1, v2 = (vertices[..., faces[:, i], :] for i in range(3))
    first, second = _usable_edges(v1 - v0, v2 - v0)
    edge_length = first.norm(dim=-1)
    along = first / edge_length[..., None]
    area_normal = torch.linalg.cross(along, second)
    height = area_normal.norm(dim=-1)
    normal = area_normal / height[..., None]
    across = torch.linalg.cross(along, normal)
    R = torch.stack([along, normal, across], dim=-1)
    return TriangleFrames(R, (v0 + v1 + v2) / 3, (edge_length + height) / 2)


def corners_in_frames(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "f 3 3"]:
    """The corners of triangles in the triangles' frames and units, whose second coordinates are 0. Differentiable."""
    frames = triangle_frames(vertices, faces)
    corners = vertices[faces.long()] - frames.T[:, None]
    return torch.einsum("fji,fcj->fci", frames.R, corners) / frames.k[:, None, None]


def triangle_ellipses(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]
) -> tuple[Float[Tensor, "f 4"], Float[Tensor, "f 3"]]:
    """Quats (wxyz) and log scales of flat Gaussians that cover triangles, in the triangles' frames and units.

    In the plane, they have the triangle's own second moments, widened so that neighbours overlap without a gap.
    """
    return ellipses_of_corners(corners_in_frames(vertices, faces), _ELLIPSE_WIDENING)


def ellipses_of_corners(
    corners: Float[Tensor, "f 3 3"], widening: float
) -> tuple[Float[Tensor, "f 4"], Float[Tensor, "f 3"]]:
    """`triangle_ellipses` from `corners_in_frames`, with scales of `widening` standard deviations. Differentiable.

    The direction of an ellipse that is a circle has no gradient.
    """
    x, z = corners[..., 0], corners[..., 2]
    xx, zz, xz = ((a * b).sum(-1) / 12 for a, b in ((x, x), (z, z), (x, z)))
    middle, apart = (xx + zz) / 2, (xx - zz) / 2
    circle = torch.hypot(apart.detach(), xz.detach()) < 1e-6 * middle.detach()
    apart, xz = torch.where(circle, 1.0, apart), xz.masked_fill(circle, 0.0)
    half = torch.hypot(apart, xz).masked_fill(circle, 0.0)
    angle = -0.5 * torch.atan2(2 * xz, 2 * apart)
    zero, flat = torch.zeros_like(angle), torch.full_like(angle, _ELLIPSE_FLATNESS)
    quats = torch.stack([(angle / 2).cos(), zero, (angle / 2).sin(), zero], dim=-1)
    wide, narrow = ((middle + sign * half).clamp_min(1e-6).sqrt() * widening for sign in (1, -1))
    return quats, torch.stack([wide, flat, narrow], dim=-1).log()


def frames_to_world(
    frames: TriangleFrames,
    face_index: Int[Tensor, " n"],
    local_means: Float[Tensor, "n 3"],
    local_quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "*b n 3"], Float[Tensor, "*b n 4"], Float[Tensor, "*b n 3"]]:
    """Means, unit quats (wxyz) and scales in world space of Gaussians bound to triangles, in plain PyTorch.

    `local_means` and exp(`log_scales`) are in units of their triangle's size. `local_quats` are normalised here.
    Differentiable in all of these and in `frames`.
    """
    R, T, k = frames.R[..., face_index, :, :], frames.T[..., face_index, :], frames.k[..., face_index, None]
    means = k * (R @ local_means[..., None])[..., 0] + T
    triangle_quats = quaternion_from_matrix(frames.R)[..., face_index, :]
    local_quats = normalize(local_quats, dim=-1).expand_as(triangle_quats)
    return means, multiply_quaternions(triangle_quats, local_quats), k * log_scales.exp()


def _bind_to_world_reference(vertices: Tensor, faces: Tensor, *gaussians: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return frames_to_world(triangle_frames(vertices, faces), *gaussians)


@native(_bind_to_world_reference)
def bind_to_world(
    vertices: Float[Tensor, "*b v 3"],
    faces: Int[Tensor, "f 3"],
    face_index: Int[Tensor, " n"],
    local_means: Float[Tensor, "n 3"],
    local_quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "*b n 3"], Float[Tensor, "*b n 4"], Float[Tensor, "*b n 3"]]:
    """`frames_to_world` of the `triangle_frames` of a posed mesh; native for float32 on a CPU.

    Gaussian i follows triangle `face_index[i]`. Leading axes of `vertices` are timesteps. Differentiable in everything
    except the indices.
    """
    one_axis = vertices.ndim == 3  # no views in this case, because each is a node of the graph
    flat = vertices if one_axis else vertices.reshape(-1, *vertices.shape[-2:])
    means, quats, scales = _BindToWorld.apply(flat, faces, face_index, local_means, local_quats, log_scales)
    if one_axis:
        return means, quats, scales
    return tuple(output.view(*vertices.shape[:-2], *output.shape[1:]) for output in (means, quats, scales))


def rig_topology(vertex_count: int, faces: Int[Tensor, "f 3"], face_index: Int[Tensor, " n"]) -> _native.RigTopology:
    """The Gaussians on each triangle, in the form that the core takes. Cached until `face_index` changes."""
    known, versions = _topologies.get(face_index), (faces._version, face_index._version)
    if known is None or known.faces is not faces or known.versions != versions or known.vertex_count != vertex_count:
        topology = _native.make_rig_topology(vertex_count, faces.contiguous(), face_index.contiguous())
        known = _topologies[face_index] = _Topology(topology, vertex_count, faces, versions)
    return known.topology


@dataclass(frozen=True, eq=False)
class _Topology:
    topology: _native.RigTopology
    vertex_count: int
    faces: Tensor
    versions: tuple[int, int]


_topologies = WeakIdKeyDictionary()
"""Cached topologies, by `face_index`."""


class _BindToWorld(torch.autograd.Function):
    @staticmethod
    def forward(ctx, vertices: Tensor, faces: Tensor, *gaussians: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        inputs = tuple(tensor.contiguous() for tensor in (vertices, faces, *gaussians))
        batch, count = len(vertices), len(gaussians[0])
        frames = recycled(batch, len(faces), _native.TRIANGLE_FRAME_FLOATS)
        means, quats, scales = (recycled(batch, count, width) for width in (3, 4, 3))
        known = unpacked(*inputs, frames, means, quats, scales)
        world = _native.WorldShapes(*known[7:])
        _native.rig_forward(known[0], known[1], known[2], _native.LocalShapes(*known[3:6]), known[6], world)
        vertices, _, _, *local = inputs
        ctx.faces, ctx.face_index = faces, gaussians[0]
        ctx.save_for_backward(vertices, *local, frames, scales)
        return means, quats, scales

    @staticmethod
    def backward(ctx, *world_gradients: Tensor):
        vertices, *local, frames, scales = ctx.saved_tensors
        if len(vertices) == 0:
            return torch.zeros_like(vertices), None, None, *(torch.zeros_like(tensor) for tensor in local)
        local_gradients = [recycled_like(tensor) for tensor in local]
        vertex_gradient = recycled_like(vertices) if ctx.needs_input_grad[0] else None
        world = [gradient.contiguous() for gradient in world_gradients]
        topology = rig_topology(vertices.shape[1], ctx.faces, ctx.face_index)
        inputs = (vertices, *local, frames, scales, *world)
        known = unpacked(*inputs, *local_gradients, vertex_gradient)
        _native.rig_backward(
            topology,
            known[0],
            _native.LocalShapes(*known[1:4]),
            known[4],
            known[5],
            _native.WorldShapes(*known[6:9]),
            _native.LocalShapes(*known[9:12]),
            known[12],
        )
        return vertex_gradient, None, None, *local_gradients


def _usable_edges(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Two edges of every triangle, replaced by constants if the triangle is degenerate."""
    edge_length = first.detach().norm(dim=-1, keepdim=True)
    double_area = torch.linalg.cross(first.detach(), second.detach()).norm(dim=-1, keepdim=True)
    degenerate = (edge_length < DEGENERATE_LENGTH) | (double_area < DEGENERATE_LENGTH * edge_length)
    axes = DEGENERATE_LENGTH * torch.eye(3, dtype=first.dtype, device=first.device)
    return torch.where(degenerate, axes[0], first), torch.where(degenerate, axes[1], second)
