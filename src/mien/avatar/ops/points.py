"""Points: random places on a mesh, and the positional encoding that the networks of several methods share."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def positional_encoding(points: Float[Tensor, "*b 3"], bands: int) -> Float[Tensor, "*b c"]:
    """Points, then sines and cosines of 1, 2, 4, ... times the points (NeRF, Mildenhall et al. 2020): 3 + 6 `bands`."""
    angles = points[..., None, :] * 2.0 ** torch.arange(bands, dtype=points.dtype, device=points.device)[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)
    return torch.cat([points, waves.flatten(-3)], dim=-1)


@torch.no_grad()
def random_places(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Triangles and barycentric coordinates of places on a mesh, uniform by area, from torch's default generator."""
    v0, v1, v2 = vertices[faces].unbind(1)
    areas = torch.linalg.cross(v1 - v0, v2 - v0).norm(dim=-1)
    chosen = torch.multinomial(areas, count, replacement=True)
    # The square root makes the points uniform over a triangle.
    along, across = torch.rand(2, count, 1).to(vertices)
    along = along.sqrt()
    return chosen, torch.cat([1 - along, along * (1 - across), along * across], dim=-1)


def at_places(
    vertices: Float[Tensor, "*b v 3"], corners: Int[Tensor, "n 3"], weights: Float[Tensor, "n 3"]
) -> Float[Tensor, "*b n 3"]:
    """The points at places of a mesh."""
    return (weights[:, :, None] * vertices[..., corners, :]).sum(-2)


def sample_surface(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int) -> Float[Tensor, "n 3"]:
    """Random points on a mesh, uniform by area, from torch's default generator."""
    triangles, weights = random_places(vertices, faces, count)
    return at_places(vertices, faces[triangles], weights)
