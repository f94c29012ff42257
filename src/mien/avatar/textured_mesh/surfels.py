"""Surfels on a mesh, and sums over neighbouring vertices.

A triangle is cut into k times k equal parts, which have its shape at 1 / k of its size, and each part has one surfel.
All of them move with the corners: a surfel has fixed barycentric coordinates and a fixed share of the triangle.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag


class Surfels(nn.Module):
    """The places of surfels on a mesh: those of one triangle follow each other, and so do triangles that are cut alike.

    Another order, or other numbers of surfels, are a ValueError.
    """

    def __init__(self, face_index: Int[Tensor, " n"], faces: int, like: Tensor):
        super().__init__()
        counts = torch.bincount(face_index.clamp(0, faces - 1), minlength=faces)
        sides = counts.double().sqrt().round().long()
        if not torch.equal(face_index, _face_index(sides)):
            raise ValueError("its surfels are not in the order of their triangles")
        self.register_buffer("order", sides.sort(stable=True).indices, persistent=False)
        found, numbers = sides.unique(return_counts=True)
        self.sides: list[int] = found.tolist()
        """Numbers of parts along an edge."""
        self.counts: list[int] = numbers.tolist()
        """Numbers of triangles that are cut so."""
        grids = torch.cat([middles_of_parts(side) for side in self.sides])
        self.register_buffer("grids", grids.to(like), persistent=False)

    def at_corners(self, corners: Float[Tensor, "*b f 3 c"]) -> Float[Tensor, "*b n c"]:
        """Values that are linear on each triangle, at the surfels."""
        grids = self.get_buffer("grids").split([side**2 for side in self.sides])
        parts = zip(self._alike(corners.transpose(-1, -2)), grids, strict=True)
        return self._joined([own @ grid.T for own, grid in parts])

    def at_triangles(self, values: Float[Tensor, "*b f c"]) -> Float[Tensor, "*b n c"]:
        """Values that are constant on each triangle, at the surfels."""
        parts = zip(self._alike(values[..., None]), self.sides, strict=True)
        return self._joined([own.expand(*own.shape[:-1], side**2) for own, side in parts])

    def shares(self) -> Float[Tensor, " n"]:
        """Length of the part that each surfel covers, as a share of its triangle's."""
        like, parts = self.get_buffer("grids"), zip(self.sides, self.counts, strict=True)
        return torch.cat([like.new_full((count * side**2,), 1 / side) for side, count in parts])

    def _alike(self, values: Float[Tensor, "*b f c k"]) -> tuple[Tensor, ...]:
        """Values of triangles, apart for those that are cut alike."""
        return values.index_select(-3, self.get_buffer("order")).split(self.counts, dim=-3)

    def _joined(self, parts: list[Tensor]) -> Float[Tensor, "*b n c"]:
        return torch.cat([one.transpose(-1, -2).flatten(-3, -2) for one in parts], dim=-2)


@torch.no_grad()
def place_surfels(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], count: int) -> Int[Tensor, " n"]:
    """The triangles of about `count` surfels that cover equal areas, at least one for each triangle."""
    v0, v1, v2 = vertices[faces.long()].unbind(1)
    areas = torch.linalg.cross(v1 - v0, v2 - v0).norm(dim=-1)
    return _face_index((areas * (count / areas.sum().clamp_min(1e-20))).sqrt().round().long().clamp_min(1))


def _face_index(sides: Int[Tensor, " f"]) -> Int[Tensor, " n"]:
    """The triangle of each surfel, if triangles are cut into so many parts along an edge."""
    ordered = sides.sort(stable=True)
    return ordered.indices.repeat_interleave(ordered.values.square())


def middles_of_parts(side: int) -> Float[Tensor, "k 3"]:
    """Barycentric coordinates of the middles of a triangle's `side` times `side` equal parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(side) for j in range(side - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(side - 1) for j in range(side - 1 - i)]
    b, c = torch.tensor(upright + turned, dtype=torch.float64).reshape(-1, 2).unbind(1)
    return torch.stack([side - b - c, b, c], dim=-1) / side


class Neighbours(nn.Module):
    """The vertices that share an edge with each vertex."""

    def __init__(self, like: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]):
        super().__init__()
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
        own, of = torch.cat([edges, edges.flip(1)]).unique(dim=0).unbind(1)
        degrees = torch.bincount(own, minlength=len(like))
        self.register_buffer("of", of.contiguous(), persistent=False)
        self.register_buffer("starts", degrees.cumsum(0) - degrees, persistent=False)
        self.register_buffer("degrees", degrees.clamp_min(1).to(like)[:, None], persistent=False)

    def means(self, values: Float[Tensor, "v c"]) -> Float[Tensor, "v c"]:
        """The mean of each vertex's neighbours, 0 if it has none."""
        sums = _NeighbourSums.apply(values, self.get_buffer("of"), self.get_buffer("starts"))
        return sums / self.get_buffer("degrees")


class _NeighbourSums(torch.autograd.Function):
    """Sums over neighbours. The matrix of neighbours is symmetric, so the gradient is the same sum."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, of: Tensor, starts: Tensor) -> Tensor:
        ctx.of, ctx.starts = of, starts
        return embedding_bag(of, values.detach().contiguous(), starts, mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return embedding_bag(ctx.of, gradient.contiguous(), ctx.starts, mode="sum"), None, None
