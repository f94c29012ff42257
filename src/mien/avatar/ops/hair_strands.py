"""Strands of hair for the back of a head that no picture shows. Without them, it is a smooth shell in one colour."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.ops.triangle_frames import TriangleFrames, triangle_frames
from mien.face.mirror import triangle_geometry
from mien.gaussians import sh_from_rgb

_STRANDS_PER_AREA = 150_000.0  # strands per square metre of scalp. Set by eye (log, 11-24)
_STRAND_LENGTH = 0.005  # scale (standard deviation) along a strand, in metres
_STRAND_WIDTH = 0.001  # scale across it, in metres
_STRAND_THICKNESS = 0.0004  # scale along the normal, in metres
_STRAND_OPACITY = 0.7  # opacity of a strand
_STRAND_DOWN = 1.0  # downward part of a strand's direction in the head frame. Set by eye
_STRAND_BACK = 0.6  # backward part of this direction. Set by eye
_STRAND_DISORDER = 0.15  # standard deviation of each coordinate of this direction. Set by eye
_STRAND_CONTRAST = 0.2
"""Standard deviation of the logarithm of a strand's brightness. Measured: 0.3, with strands on top of the hair, has
.217 in ST-LPIPS at 90 degrees instead of .199 (log, 11-24)."""
_STRAND_DEPTH = 0.003
"""Range below the top of the hair in which strands lie, in metres. Above it, they would widen the outline. Measured: 1
mm has .205 in ST-LPIPS at 90 degrees, 3 mm .183 (log, 11-24)."""
_HEAD_RADIUS = 0.1  # radius in metres of the head that hair is a shell around. Geometry of a head
_NECK_RADIUS = 0.055  # radius in metres of the neck that hanging hair is a shell around. Geometry of a neck
_CHIN_LEVEL = -0.05  # level in the head frame, in metres, below which hair is around the neck. Geometry of a head


def strand_gaussians(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    chosen: Bool[Tensor, " f"],
    height: Float[Tensor, " f"],
    colors: Float[Tensor, "f 3"],
) -> dict[str, Tensor]:
    """Gaussians that look like strands, in the frames and units of their triangles. They are the same in every call.

    Strands lie on the surface of the hair, point down and back, and differ in brightness. They are evenly spread over
    the chosen triangles of a neutral head in the head frame (y up, z ahead), in metres. Colours are 0..1. The result
    has the tensors of a store, with one row for each strand.
    """
    vertices, random = vertices.detach(), torch.Generator().manual_seed(0)
    frames = triangle_frames(vertices, faces)
    triangles = _evenly_drawn(vertices, faces, chosen)
    count, size, high = len(triangles), frames.k[triangles], height[triangles]
    means = _to_triangles(frames, triangles, _places(vertices, faces, triangles, random) - frames.T[triangles])
    means = means * shell_growth(vertices, faces, height)[triangles, None]
    means[:, 1] = high - _STRAND_DEPTH * torch.rand(count, generator=random)
    combed = torch.tensor([0.0, -_STRAND_DOWN, -_STRAND_BACK])
    direction = combed + _STRAND_DISORDER * torch.randn(count, 3, generator=random)
    along = _to_triangles(frames, triangles, direction)
    # A turn about the normal, the second axis, takes the first axis to (cos, 0, -sin).
    half, zero = 0.5 * torch.atan2(-along[:, 2], along[:, 0]), torch.zeros(count)
    scales = torch.tensor([_STRAND_LENGTH, _STRAND_THICKNESS, _STRAND_WIDTH]) / size[:, None]
    contrast = _STRAND_CONTRAST
    light = torch.exp(contrast * torch.randn(count, 1, generator=random) - 0.5 * contrast**2)
    return {
        "face_index": triangles,
        "means": means / size[:, None],
        "quats": torch.stack([half.cos(), zero, half.sin(), zero], dim=1),
        "log_scales": scales.log(),
        "opacity_logits": torch.logit(torch.full((count,), _STRAND_OPACITY)),
        "sh_constant": sh_from_rgb((colors[triangles] * light).clamp(0, 1))[:, None],
    }


def shell_growth(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], height: Float[Tensor, " f"]
) -> Float[Tensor, " f"]:
    """How much larger than its triangle a patch of hair is, as a factor on lengths, at a height above it in metres.

    Hair is a shell around the head or, where it hangs, around the neck, which is thinner.
    """
    below = triangle_geometry(vertices.detach(), faces)[0][:, 1] < _CHIN_LEVEL
    return 1 + height / torch.where(below, _NECK_RADIUS, _HEAD_RADIUS).to(height)


def _evenly_drawn(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], chosen: Bool[Tensor, " f"]
) -> Int[Tensor, " n"]:
    """The triangle of each strand. A triangle has as many as its area says, rounded down or up."""
    areas = triangle_geometry(vertices.double(), faces)[1]
    ends = (areas * chosen * _STRANDS_PER_AREA).cumsum(0)
    points = torch.arange(int(ends[-1])) + 0.5
    return torch.searchsorted(ends, points.double(), right=True)


def _places(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], triangles: Int[Tensor, " n"], random: torch.Generator
) -> Float[Tensor, "n 3"]:
    share = torch.rand(len(triangles), 2, generator=random)
    share = torch.where(share.sum(1, keepdim=True) > 1, 1 - share, share)
    weights = torch.cat([1 - share.sum(1, keepdim=True), share], dim=1)
    return (weights[..., None] * vertices[faces[triangles].long()]).sum(1)


def _to_triangles(
    frames: TriangleFrames, triangles: Int[Tensor, " n"], vectors: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    return torch.einsum("nji,nj->ni", frames.R[triangles], vectors)
