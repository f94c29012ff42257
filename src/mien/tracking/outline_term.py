"""The cost of a head's outline: where it ends against the background, as mattes have it.

Landmarks and texture lie on the face; how far away from it ears and jaw sides appear tells perspective, and with it the
focal length and which way the head is turned. Points of the mesh's outline are drawn to the nearest edge of the matte
along the outline's normal.
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
from mien.tracking.landmark_term import Subject
from mien.tracking.photometric_surface import SurfaceModel, by_log_focal
from mien.tracking.photometric_threads import in_threads
from mien.tracking.solver import NormalEquations, SharedEquations
from mien.tracking.views import CameraBatch, Views

_HIDDEN_REGIONS = ("scalp", "neck", "mouth", "teeth", "tongue", "eye_sockets", "eyes", "irises", "eyelids")
"""Whose outline says nothing: hair, collars and lashes are there."""
_REACH = 0.012
"""Metres along the normal within which an edge of the matte is looked for."""
_PROFILE = 49
"""Samples of the matte along the normal."""
_BESIDE = 1.5
"""Pixels outside of the outline where nothing of the mesh may be."""
_SIGMA = 0.0015
"""Expected distance, metres."""
_OUTLIERS = (4.0, 2.0)
"""In sigmas, of mattes that end inside of the mesh and outside: hair, beards and collars stand out."""


@dataclass(frozen=True, eq=False)
class Outline:
    """k points of a posed mesh's outline in a picture."""

    ends: Int[Tensor, "k 2"]
    """The vertices of the edge whose middle the point is."""
    points: Float[Tensor, "k 2"]
    """Pixels."""
    normals: Float[Tensor, "k 2"]
    """Unit, outwards."""
    lengths: Float[Tensor, " k"]
    """Of the edges, pixels."""


@dataclass(frozen=True, eq=False)
class OutlineTerm:
    """Costs of the v timesteps of one sequence: the robust mean over each picture's outline."""

    model: SurfaceModel
    capture: Capture
    timesteps: Int[Tensor, " v"]
    """Of the capture."""
    views: Views
    ends: Int[Tensor, "e 2"]
    """Vertices of the mesh's edges."""
    sides: Int[Tensor, "e 2"]
    """Their triangles."""
    used: Bool[Tensor, " f"]
    """Triangles whose outline says something."""
    weight: float
    """What the outline of a picture is worth."""

    def joint_equations(
        self, state: Float[Tensor, "v p"], rows: Int[Tensor, " k"], subject: Subject, cameras: CameraBatch
    ) -> tuple[NormalEquations, SharedEquations]:
        """Of some timesteps, and of what they share: `Subject.shared`, then the logarithm of the focal length."""
        size = state.shape[1] + len(subject.columns_of_pixels)

        def of_row(row: int) -> tuple[float, Tensor, Tensor]:
            posed = self.model.pose(state[row], subject.identity, derive_identity=True)
            assert posed.jacobian is not None
            seen_by = self.views.seen_by(row)
            jacobian = torch.cat([posed.jacobian, by_log_focal(posed.vertices, cameras, seen_by)], dim=2)
            cost, gradient, hessian = 0.0, torch.zeros(size).double(), torch.zeros(size, size).double()
            for camera in seen_by:
                slopes, distance, weights, own = self._residuals(posed.vertices, jacobian, row, camera, cameras)
                cost += self.weight * own
                gradient -= self.weight * (slopes.T @ (weights * distance))
                hessian += self.weight * (slopes.T @ (weights[:, None] * slopes))
            return cost, gradient, hessian

        parts = in_threads(of_row, rows.tolist())
        cost = torch.tensor([part[0] for part in parts]).double()
        gradient, hessian = torch.stack([part[1] for part in parts]), torch.stack([part[2] for part in parts])
        whole = NormalEquations(cost, gradient, hessian)
        return whole.split(state.shape[1], subject.columns_of_pixels, len(subject.shared) + 1)

    def _residuals(
        self,
        vertices: Float[Tensor, "v 3"],
        jacobian: Float[Tensor, "v 3 q"],
        row: int,
        camera: int,
        cameras: CameraBatch,
    ) -> tuple[Float[Tensor, "k q"], Float[Tensor, " k"], Float[Tensor, " k"], float]:
        """Of one picture: how the points move outwards, how far they should, their weights, and the cost."""
        size = (self.capture.width, self.capture.height)
        view = Camera(cameras.K[camera], cameras.viewmat[camera], *size).to(torch.zeros(()))
        outline = self.outline(vertices, view)
        middle = vertices[outline.ends].mean(1) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        x, y, z = middle.unbind(-1)
        scale = float(view.K[0, 0] / vertices.new_tensor([z.median() if len(z) else 1.0]))
        matte = np.asarray(self.capture.mattes[int(self.timesteps[row]), camera])
        distance = edge_distances(matte, outline, _REACH * scale)
        seen = distance.isfinite()
        zero = torch.zeros_like(x)
        by_point = torch.stack([
            torch.stack([view.K[0, 0] / z, zero, -view.K[0, 0] * x / z**2], -1),
            torch.stack([zero, view.K[1, 1] / z, -view.K[1, 1] * y / z**2], -1),
        ], dim=1)  # fmt: skip
        outwards = torch.einsum("kx,kxc->kc", outline.normals, by_point) @ view.viewmat[:3, :3]
        moved = jacobian[outline.ends[:, 0]] + jacobian[outline.ends[:, 1]]
        slopes = 0.5 * torch.einsum("kc,kcq->kq", outwards, moved)
        sigma = _SIGMA * scale
        squared = (distance[seen] / sigma).square()
        least = torch.where(distance[seen] < 0, *_OUTLIERS) ** 2
        share = outline.lengths[seen] / outline.lengths.sum().clamp_min(1.0)
        weights = share * (least / (least + squared)).square() / sigma**2
        cost = float((share * least * squared / (least + squared)).sum())
        return slopes[seen].double(), distance[seen].double(), weights.double(), cost

    def outline(self, vertices: Float[Tensor, "v 3"], camera: Camera) -> Outline:
        """Where the mesh ends against what is not mesh."""
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
        reach = _REACH * camera.K[0, 0] / depth
        free = torch.ones(len(points), dtype=torch.bool)
        for step in (torch.full_like(reach, _BESIDE), 0.25 * reach, 0.5 * reach, reach):
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
    """Whether there is mesh; outside of the picture nobody knows."""
    height, width = drawn.shape
    column, row = points.floor().long().unbind(1)
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return ~within | (drawn[row.clamp(0, height - 1), column.clamp(0, width - 1)] >= 0)


def edge_distances(matte: np.ndarray, outline: Outline, reach: float) -> Float[Tensor, " k"]:
    """How far along its normal each point is from where the matte ends, pixels; NaN where that is not within reach."""
    steps = np.linspace(-reach, reach, _PROFILE, dtype=np.float32)
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
