"""Random places on a mesh."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


@torch.no_grad()
def random_places(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int
) -> tuple[Int[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Corners and barycentric coordinates of places on a mesh, uniform by area, from torch's default generator."""
    v0, v1, v2 = vertices[faces].unbind(1)
    areas = torch.linalg.cross(v1 - v0, v2 - v0).norm(dim=-1)
    chosen = torch.multinomial(areas, count, replacement=True)
    # The square root makes the points uniform over a triangle.
    along, across = torch.rand(2, count, 1).to(vertices)
    along = along.sqrt()
    return faces[chosen], torch.cat([1 - along, along * (1 - across), along * across], dim=-1)


def at_places(
    vertices: Float[Tensor, "*b v 3"], corners: Int[Tensor, "n 3"], weights: Float[Tensor, "n 3"]
) -> Float[Tensor, "*b n 3"]:
    """The points at places of a mesh."""
    return (weights[:, :, None] * vertices[..., corners, :]).sum(-2)


def sample_surface(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int) -> Float[Tensor, "n 3"]:
    """Random points on a mesh, uniform by area, from torch's default generator."""
    return at_places(vertices, *random_places(vertices, faces, count))
