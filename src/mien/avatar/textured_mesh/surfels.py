"""Surfels on a mesh, and sums over neighbouring vertices.

A triangle is cut into k times k equal parts, which have its shape at 1 / k of its size, and each part has one surfel.
All of them move with the corners: a surfel has fixed barycentric coordinates and a fixed share of the triangle.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag


@dataclass(frozen=True, eq=False)
class _Group:
    """Triangles that are cut alike."""

    grid: Float[Tensor, "k 3"]
    """Barycentric coordinates of their surfels."""
    side: int
    """Number of parts along an edge."""
    count: int
    """Number of triangles."""


class Surfels:
    """The places of surfels on a mesh: those of one triangle follow each other, and so do triangles that are cut alike.

    Args:
        face_index: The triangle of each surfel, in that order.
        faces: Number of triangles.
        like: A tensor with the dtype of the coordinates.

    Raises:
        ValueError: `face_index` is in another order, or has other numbers of surfels.
    """

    def __init__(self, face_index: Int[Tensor, " n"], faces: int, like: Tensor):
        counts = torch.bincount(face_index.clamp(0, faces - 1), minlength=faces)
        sides = counts.double().sqrt().round().long()
        self._order = sides.sort(stable=True).indices
        if not torch.equal(face_index, _face_index(sides)):
            raise ValueError("its surfels are not in the order of their triangles")
        found, numbers = sides.unique(return_counts=True)
        self._groups = [
            _Group(_middles(side).to(like), side, count)
            for side, count in zip(found.tolist(), numbers.tolist(), strict=True)
        ]

    def at_corners(self, corners: Float[Tensor, "*b f 3 c"]) -> Float[Tensor, "*b n c"]:
        """Values that are linear on each triangle, at the surfels."""
        return self._at_surfels(corners.transpose(-1, -2), lambda own, group: own @ group.grid.T)

    def at_triangles(self, values: Float[Tensor, "*b f c"]) -> Float[Tensor, "*b n c"]:
        """Values that are constant on each triangle, at the surfels."""
        return self._at_surfels(values[..., None], lambda own, group: own.expand(*own.shape[:-1], group.side**2))

    def shares(self) -> Float[Tensor, " n"]:
        """Length of the part that each surfel covers, as a share of its triangle's."""
        return torch.cat(
            [group.grid.new_full((group.count * group.side**2,), 1 / group.side) for group in self._groups]
        )

    def _at_surfels(self, values: Tensor, spread: Any) -> Tensor:
        parts = values.index_select(-3, self._order).split([group.count for group in self._groups], dim=-3)
        spreads = [spread(own, group) for own, group in zip(parts, self._groups, strict=True)]
        return torch.cat([one.transpose(-1, -2).flatten(-3, -2) for one in spreads], dim=-2)


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


def _middles(side: int) -> Float[Tensor, "k 3"]:
    """Barycentric coordinates of the middles of a triangle's `side` times `side` equal parts."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(side) for j in range(side - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(side - 1) for j in range(side - 1 - i)]
    b, c = torch.tensor(upright + turned, dtype=torch.float64).reshape(-1, 2).unbind(1)
    return torch.stack([side - b - c, b, c], dim=-1) / side


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The vertices that share an edge with each vertex, one vertex after the other."""

    of: Int[Tensor, " p"]
    starts: Int[Tensor, " v"]
    """Index into `of` of each vertex's first neighbour."""
    degrees: Float[Tensor, "v 1"]
    """Number of neighbours, at least 1."""

    def means(self, values: Float[Tensor, "v c"]) -> Float[Tensor, "v c"]:
        """The mean of each vertex's neighbours, 0 if it has none."""
        return _NeighbourSums.apply(values, self.of, self.starts) / self.degrees


def neighbours_of(like: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Neighbours:
    """The neighbours of the vertices `like`, whose numbers are on its device."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).long()
    own, of = torch.cat([edges, edges.flip(1)]).unique(dim=0).unbind(1)
    degrees = torch.bincount(own, minlength=len(like))
    return Neighbours(of.contiguous(), degrees.cumsum(0) - degrees, degrees.clamp_min(1).to(like)[:, None])


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
