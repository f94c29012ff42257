"""Gaussians belong to the triangle that they lie on.

Training moves a Gaussian away from the triangle that it started on, often across several others. It still turns and
grows with its own, about that triangle's centre, so in a face that was not filmed it leaves the surface: needles,
seams, torn rims of glasses. Bound anew, it bends with what is below it. Not part of any of the three papers.
"""

from collections.abc import Mapping
from collections.abc import Sequence as Items

import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from torch import Tensor

from mien.adam import Moments
from mien.avatar.ops import Tensors
from mien.avatar.ops.triangle_frames import triangle_frames
from mien.rotation import multiply_quaternions, quaternion_from_matrix

_OUTSIDE = -0.05
"""Smallest barycentric coordinate below which a Gaussian lies beside its triangle. At 0, it would change to and fro."""
_FACING = 0.5
"""Smallest cosine between the normals of triangles that a Gaussian may change between. A thin part has two sides."""


class Binding:
    """The triangles of a person's neutral head, which finds the one that a Gaussian lies on.

    Args:
        vertices: The vertices of the neutral head, in metres.
        faces: Its triangles.
        kinds: A number for each triangle. Gaussians change only between triangles of one kind, from 0.
    """

    def __init__(self, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], kinds: Int[Tensor, " f"]):
        self._frames, self._corners = triangle_frames(vertices, faces), vertices[faces.long()]
        self._beside = _triangles_beside(faces, kinds, self._frames.R[:, :, 1])

    @torch.no_grad()
    def renew(
        self,
        store: Tensors,
        limits: Float[Tensor, "f 5"] | None = None,
        shifts: Items[str] = (),
        moments: Mapping[str, object] | None = None,
    ) -> None:
        """Bind Gaussians beside their triangle to the nearest one that shares a corner with it (`bind`).

        Those that would be beyond the new triangle's limits (`limits_of_triangles`) stay: hair beside a bare cheek.
        """
        own = store["face_index"].long()
        places = self._places(store, own)
        beside = (barycentric(places, self._corners[own]).amin(1) < _OUTSIDE).nonzero()[:, 0]
        nearest = self._nearest(places[beside], own[beside])
        changed = nearest != own[beside]
        rows, new = beside[changed], nearest[changed]
        if limits is not None:
            k, normals, T = self._frames.k, self._frames.R[:, :, 1], self._frames.T
            heights = (normals[new] * (places[rows] - T[new])).sum(1) / k[new]
            sizes = store["log_scales"].detach()[rows] + (k[own[rows]] / k[new]).log()[:, None]
            low, high, thick, wide, _ = limits[new].unbind(1)
            fits = (heights >= low) & (heights <= high) & (sizes[:, 1] <= thick) & (sizes[:, [0, 2]].amax(1) <= wide)
            rows, new = rows[fits], new[fits]
        self.bind(store, rows, new, shifts, moments)

    @torch.no_grad()
    def bind(
        self,
        store: Tensors,
        rows: Int[Tensor, " k"],
        triangles: Int[Tensor, " k"],
        shifts: Items[str] = (),
        moments: Mapping[str, object] | None = None,
    ) -> None:
        """Bind some Gaussians to other triangles, in place.

        Their places and shapes on the neutral head stay what they are. So do the shifts of their centres, which are
        tensors [n, 3, r] of the store, and what an optimiser knows of all these.
        """
        bound, R, T, k = store["face_index"], self._frames.R, self._frames.T, self._frames.k
        old, new = bound[rows].long(), triangles.long()
        places = self._places(store, bound.long())[rows]
        turns, growth = R[new].mT @ R[old], k[old] / k[new]
        # Multiplication by a quaternion from the left is a matrix product, too.
        units = torch.eye(4).to(turns).expand(len(rows), 4, 4)
        left = multiply_quaternions(quaternion_from_matrix(turns)[:, None].expand_as(units), units).mT
        store["means"].detach()[rows] = (R[new].mT @ (places - T[new])[..., None])[..., 0] / k[new, None]
        store["quats"].detach()[rows] = (left @ store["quats"].detach()[rows][..., None])[..., 0]
        store["log_scales"].detach()[rows] += growth.log()[:, None]
        for name in shifts:
            store[name].detach()[rows] = growth[:, None, None] * (turns @ store[name].detach()[rows])
        for name in ("means", "quats", *shifts):
            if isinstance(known := (moments or {}).get(name), Moments):
                # A gradient turns with its tensor, and shrinks where that grows.
                turn = left if name == "quats" else turns / growth[:, None, None]
                _turn_rows(known.first, rows, turn)
                _turn_rows(known.second, rows, turn.square())
        bound[rows] = new.to(bound)

    def _places(self, store: Tensors, own: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Centres on the neutral head, in metres."""
        R, T, k = self._frames.R[own], self._frames.T[own], self._frames.k[own]
        return k[:, None] * (R @ store["means"].detach()[..., None])[..., 0] + T

    def _nearest(self, points: Float[Tensor, "n 3"], own: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Each point's nearest triangle: its own, or one that shares a corner with it."""
        nearest, least = own, squared_distances(points, self._corners[own])
        for column in self._beside[own].unbind(1):
            candidates = torch.where(column < 0, own, column)
            distances = squared_distances(points, self._corners[candidates])
            nearest, least = torch.where(distances < least, candidates, nearest), torch.minimum(distances, least)
        return nearest


def _turn_rows(values: Float[Tensor, "n d *r"], rows: Int[Tensor, " k"], turns: Float[Tensor, "k d d"]) -> None:
    columns = values[rows].view(len(rows), turns.shape[1], -1)
    values[rows] = (turns @ columns).view_as(values[rows])


def barycentric(points: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3"]:
    """Coordinates of points in triangles, after their projection to the triangles' planes. Sums are 1."""
    a, b, c = corners.unbind(1)
    first, second, to_point = b - a, c - a, points - a
    normal = torch.linalg.cross(first, second)
    doubled = normal.square().sum(1).clamp_min(1e-24)
    third = (torch.linalg.cross(first, to_point) * normal).sum(1) / doubled
    middle = (torch.linalg.cross(to_point, second) * normal).sum(1) / doubled
    return torch.stack([1 - middle - third, middle, third], 1)


def squared_distances(points: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Squared distances of points from triangles, in the unit of both."""
    weights = barycentric(points, corners)
    to_plane = (points - (weights[..., None] * corners).sum(1)).square().sum(1)
    following = corners.roll(-1, 1)
    edges = following - corners
    along = ((points[:, None] - corners) * edges).sum(-1) / edges.square().sum(-1).clamp_min(1e-24)
    to_edges = (points[:, None] - torch.lerp(corners, following, along.clamp(0, 1)[..., None])).square().sum(-1)
    return torch.where((weights >= 0).all(1), to_plane, to_edges.amin(1))


def _triangles_beside(
    faces: Int[Tensor, "f 3"], kinds: Int[Tensor, " f"], normals: Float[Tensor, "f 3"]
) -> Int[Tensor, "f b"]:
    """The triangles of the same kind that share a corner with each and face about the same way. -1 fills the rows."""
    own, kinds, normals = faces.long().cpu(), kinds.cpu(), normals.cpu()
    count = len(own)
    rows = torch.arange(count).repeat_interleave(3).numpy()
    at = coo_array((torch.ones(3 * count, dtype=torch.int32).numpy(), (rows, own.flatten().numpy())))
    shared = (at @ at.T).tocoo()
    one, other = (torch.from_numpy(index).long() for index in shared.coords)
    usable = (
        (one != other)
        & (kinds[one] == kinds[other])
        & (kinds[one] >= 0)
        & ((normals[one] * normals[other]).sum(1) > _FACING)
    )
    one, other = one[usable], other[usable]
    order = (one * count + other).argsort()
    one, other = one[order], other[order]
    each = torch.bincount(one, minlength=count)
    place = torch.arange(len(one)) - (each.cumsum(0) - each)[one]
    beside = torch.full((count, int(each.max())), -1)
    beside[one, place] = other
    return beside.to(faces.device)
