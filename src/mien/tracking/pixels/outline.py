"""The cost of a head's outline: the distance from the mesh's outline to the edge of the matte.

Landmarks and texture lie on the face. How far from it the ears and the sides of the jaw appear shows the perspective,
and with it the focal length and the direction of the head. Points of the mesh's outline are pulled to the nearest edge
of the matte along the outline's normal.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.render.mesh import rasterize_mesh
from mien.render.mesh_gradients import mesh_edges
from mien.tracking.fitting.fit import Subject
from mien.tracking.fitting.solver import NormalEquations, SharedEquations
from mien.tracking.fitting.views import CameraBatch, Views
from mien.tracking.pixels.surface import PosedSurface, SurfaceModel, equations_of_pictures

_OUTLINE_REACH = 0.012  # largest distance along the normal at which an edge of the matte is searched, in metres
_OUTLINE_BESIDE = 1.5  # distance outside of the outline, in pixels, at which there must be no mesh
_OUTLINE_SIGMA = 0.0015  # expected distance between outline and matte, in metres. Set with the outlier thresholds
_OUTLINE_OUTLIERS = (4.0, 2.0)
"""Outlier thresholds in these standard deviations, for mattes that end inside and outside of the mesh. The second is
smaller, because hair, beards and collars extend the matte. Chosen on d3, whose hair over the ears pulled them outwards
(log)."""

_HIDDEN_REGIONS = ("scalp", "neck", "mouth", "teeth", "tongue", "eye_sockets", "eyes", "irises", "eyelids")
"""Regions whose outline is not used, because hair, collars and lashes hide it."""


@dataclass(frozen=True, eq=False)
class Outline:
    """k points of a posed mesh's outline in a picture."""

    ends: Int[Tensor, "k 2"]
    """The two vertices of each edge. The point is the middle of the edge."""
    points: Float[Tensor, "k 2"]
    """Positions of the points, in pixels."""
    normals: Float[Tensor, "k 2"]
    """Unit normals that point outwards."""
    lengths: Float[Tensor, " k"]
    """Lengths of the edges, in pixels."""


@dataclass(frozen=True, eq=False)
class OutlineTerm:
    """Outline costs of the v timesteps of one sequence: a robust mean over each picture's outline."""

    model: SurfaceModel
    capture: Capture
    timesteps: Int[Tensor, " v"]
    """Timesteps of the capture."""
    views: Views
    ends: Int[Tensor, "e 2"]
    """The two vertices of each edge of the mesh."""
    sides: Int[Tensor, "e 2"]
    """The two triangles at each edge."""
    used: Bool[Tensor, " f"]
    """Which triangles have an outline that is used."""
    weight: float
    """Weight of the outline of a picture."""

    def joint_equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch
    ) -> tuple[NormalEquations, SharedEquations]:
        """The equations of timesteps and of the shared parameters: `Subject.shared`, logarithm of the focal length."""
        whole = equations_of_pictures(
            self.model, self.views, state, rows, subject, cameras, self.weight, self._of_picture, shared=True
        )
        return whole.split(state.shape[1], subject.columns_of_pixels, len(subject.shared) + 1)

    def _of_picture(
        self, posed: PosedSurface, row: int, camera: int, cameras: CameraBatch
    ) -> tuple[float, Float[Tensor, " q"], Float[Tensor, "q q"]]:
        """Cost of one picture, half its gradient and half its Hessian."""
        vertices, jacobian = posed.vertices, posed.jacobian
        assert jacobian is not None
        size = (self.capture.width, self.capture.height)
        view = Camera(cameras.K[camera], cameras.viewmat[camera], *size).to(torch.zeros(()))
        outline = self.outline(vertices, view)
        x, y, z = (vertices[outline.ends].mean(1) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).unbind(-1)
        scale = float(view.K[0, 0] / vertices.new_tensor([z.median() if len(z) else 1.0]))
        matte = np.asarray(self.capture.mattes[int(self.timesteps[row]), camera])
        distance = edge_distances(matte, outline, _OUTLINE_REACH * scale)
        seen, zero = distance.isfinite(), torch.zeros_like(x)
        by_point = torch.stack([
            torch.stack([view.K[0, 0] / z, zero, -view.K[0, 0] * x / z**2], -1),
            torch.stack([zero, view.K[1, 1] / z, -view.K[1, 1] * y / z**2], -1),
        ], dim=1)  # fmt: skip
        outwards = torch.einsum("kx,kxc->kc", outline.normals, by_point) @ view.viewmat[:3, :3]
        moved = jacobian[outline.ends[:, 0]] + jacobian[outline.ends[:, 1]]
        slopes = (0.5 * torch.einsum("kc,kcq->kq", outwards, moved))[seen].double()
        distance, sigma = distance[seen], _OUTLINE_SIGMA * scale
        squared = (distance / sigma).square()
        least = torch.where(distance < 0, *_OUTLINE_OUTLIERS) ** 2
        share = outline.lengths[seen] / outline.lengths.sum().clamp_min(1.0)
        weights = (share * (least / (least + squared)).square() / sigma**2).double()
        cost = float((share * least * squared / (least + squared)).sum())
        return cost, -(slopes.T @ (weights * distance.double())), slopes.T @ (weights[:, None] * slopes)

    def outline(self, vertices: Float[Tensor, "v 3"], camera: Camera) -> Outline:
        """The points of the mesh's outline against the background."""
        faces = self.model.face_model.faces
        pixels, _ = camera.project(vertices)
        first, second, third = pixels[faces].unbind(1)
        along, beside = second - first, third - first
        front = along[:, 0] * beside[:, 1] - along[:, 1] * beside[:, 0] < 0  # y points down
        near = torch.where(front[self.sides[:, 0]], self.sides[:, 0], self.sides[:, 1])
        edge = front[self.sides].sum(1) == 1
        edge &= self.used[near]
        ends, near = self.ends[edge], near[edge]
        points, along = pixels[ends].mean(1), pixels[ends[:, 1]] - pixels[ends[:, 0]]
        lengths = along.norm(dim=1)
        normals = torch.stack([-along[:, 1], along[:, 0]], 1) / lengths.clamp_min(1e-6)[:, None]
        inside = pixels[faces[near]].mean(1)
        normals = normals * torch.where(((points - inside) * normals).sum(1, keepdim=True) < 0, -1.0, 1.0)
        drawn = rasterize_mesh(vertices, faces, camera).face_index
        depth = (vertices[ends].mean(1) @ camera.viewmat[2, :3]) + camera.viewmat[2, 3]
        reach = _OUTLINE_REACH * camera.K[0, 0] / depth
        free = torch.ones(len(points), dtype=torch.bool)
        for step in (torch.full_like(reach, _OUTLINE_BESIDE), 0.25 * reach, 0.5 * reach, reach):
            free &= ~_covered(drawn, points + step[:, None] * normals)
        return Outline(ends[free], points[free], normals[free], lengths[free])


def outline_term(
    model: SurfaceModel, capture: Capture, timesteps: Int[Tensor, " v"], views: Views, weight: float
) -> OutlineTerm:
    """The cost of the outlines of one sequence."""
    edges = mesh_edges(model.face_model.faces)
    whole = (edges.faces >= 0).all(1)
    ends, sides = edges.vertices[whole].long(), edges.faces[whole].long()
    used = ~model.face_model.region_mask(*_HIDDEN_REGIONS)
    return OutlineTerm(model, capture, timesteps, views, ends, sides, used, weight)


def _covered(drawn: Int[Tensor, "h w"], points: Float[Tensor, "k 2"]) -> Bool[Tensor, " k"]:
    """Whether the mesh covers each point. Points outside of the picture count as covered."""
    height, width = drawn.shape
    column, row = points.floor().long().unbind(1)
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return ~within | (drawn[row.clamp(0, height - 1), column.clamp(0, width - 1)] >= 0)


def edge_distances(matte: np.ndarray, outline: Outline, reach: float) -> Float[Tensor, " k"]:
    """Distance along the normal from each point to the edge of the matte, in pixels; NaN if there is none in reach."""
    steps = np.linspace(-reach, reach, 49, dtype=np.float32)  # number of samples of the matte along the normal
    path = outline.points.numpy()[:, None] + steps[:, None] * outline.normals.numpy()[:, None]
    if not len(path):
        return torch.zeros(0)
    map_x, map_y = (np.ascontiguousarray(path[..., axis] - 0.5, dtype=np.float32) for axis in (0, 1))
    profile = cv2.remap(matte, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    profile = profile / 255 - 0.5
    ends = (profile[:, :-1] > 0) & (profile[:, 1:] <= 0)
    part = profile[:, :-1] / np.maximum(profile[:, :-1] - profile[:, 1:], 1e-6)
    where = np.where(ends, steps[:-1] + (steps[1] - steps[0]) * np.clip(part, 0, 1), np.inf)
    nearest = where[np.arange(len(where)), np.abs(where).argmin(1)]
    return torch.from_numpy(np.where(np.isfinite(nearest), nearest, np.nan).astype(np.float32))
