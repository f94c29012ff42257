"""The neck cut: where the body is cut off below the head, as one surface in space that all cameras see alike."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.tracking.neck_line import bottom_vertices, neck_vertices

_RAISED = 0.4
"""Height of the cut above the base of the neck, as a share of the way to the middle of the neck: above most collars.
Measured: without the raise, the front of `mono-sides` has 2 dB less (log, "Capture", 11-23)."""
_BESIDE = 1.15  # radius that is kept at the neck cut, in radii of the neck. Set by eye
_SLOPE = 1.0
"""Growth of that radius with the height above the cut. Hair is kept; collars and shoulders are cut off. Set by eye."""
_BAND = 64  # rows of a picture whose cut is computed at once


@dataclass(frozen=True, eq=False)
class NeckCut:
    """A plane across the lower neck, and the neck as an elliptic cylinder on it, of one timestep."""

    origin: Float[np.ndarray, " 3"]
    """Middle of the cylinder on the plane, in world coordinates."""
    axes: Float[np.ndarray, "3 3"]
    """Rows: the cylinder's two principal directions, and its axis, which points to the head. Orthonormal."""
    radii: Float[np.ndarray, " 2"]
    """Half lengths of the ellipse along the first two axes, in metres."""

    def heights(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Signed distances of points from the plane in metres, positive on the head's side."""
        origin, up = (torch.from_numpy(vector).to(points) for vector in (self.origin, self.axes[2]))
        return (points - origin) @ up

    def margins(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Distances of points from what is cut off, below the plane and beside the neck, in metres; negative there."""
        origin, axes, radii = (torch.from_numpy(array).to(points) for array in (self.origin, self.axes, self.radii))
        local = (points - origin) @ axes.T
        beside = radii.prod().sqrt() * (_BESIDE - (local[:, :2] / radii).norm(dim=1)) + _SLOPE * local[:, 2]
        return torch.minimum(local[:, 2], beside)


@dataclass(frozen=True, eq=False)
class NeckParts:
    """The vertices of a face model that place the cut."""

    base: Int[Tensor, " n"]
    """The lowest boundary of the mesh (`bottom_vertices`)."""
    middle: Int[Tensor, " m"]
    """The vertices around the middle of the neck (`neck_vertices`)."""

    @classmethod
    def of(cls, face_model: FaceModel) -> "NeckParts":
        """The parts of a face model."""
        return cls(bottom_vertices(face_model), neck_vertices(face_model))


def fit_neck_cut(parts: NeckParts, vertices: Float[Tensor, "v 3"], up: Float[Tensor, " 3"]) -> NeckCut:
    """Fit the cut to a posed mesh, in world coordinates in metres. `up` points to the head's side of the plane.

    The plane is parallel to the one that fits the base of the neck best (total least squares).
    """
    points, ring = (vertices.numpy()[indices.numpy()].astype(float) for indices in (parts.base, parts.middle))
    center = points.mean(0)
    normal = np.linalg.eigh((points - center).T @ (points - center))[1][:, 0]
    normal = normal if normal @ up.numpy() > 0 else -normal
    offsets = ring - ring.mean(0)
    flat = offsets - np.outer(offsets @ normal, normal)
    first = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    axes = np.stack([first, np.cross(normal, first), normal])
    radii = np.maximum(np.abs(offsets @ axes[:2].T).max(0), 1e-3)
    middle = ring.mean(0)
    return NeckCut(middle - (1 - _RAISED) * normal * ((middle - center) @ normal), axes, radii)


class _Rays(NamedTuple):
    """The rays of a camera's pixels in the frame of a cut."""

    start: Float[np.ndarray, " 3"]
    """The camera's centre."""
    turned: Float[np.ndarray, "3 3"]
    """From pixels to directions of depth 1 along the camera's axis."""
    width: int
    """Number of pixels in a row."""
    focal: np.float32
    """Focal length in pixels."""


def above_neck_cut(cut: NeckCut, camera: Camera) -> Float[np.ndarray, "h w"]:
    """1 above the cut and near the neck, 0 elsewhere, with soft borders about one pixel wide.

    The ray of a pixel is judged where it meets the cylinder, or where it passes nearest to its axis. So all cameras
    cut the skin of a neck at the same place, which a straight line in each picture does not. Rows are taken in bands,
    because the temporary arrays of a whole picture are many times as large as the picture.
    """
    bands = (range(row, min(row + _BAND, camera.height)) for row in range(0, camera.height, _BAND))
    K, view = camera.K.numpy().astype(float), camera.viewmat.numpy()
    x, y, z = view[:3, :3] * view[:3, 3:]
    eye = -((x + y) + z).astype(float)
    start = ((eye - cut.origin) @ cut.axes.T).astype(np.float32)
    turned = cut.axes @ (view[:3, :3].astype(float).T @ np.linalg.inv(K))
    rays = _Rays(start, turned, camera.width, np.float32(K[1, 1]))
    return np.concatenate([_above_in_rows(cut, rays, band) for band in bands])


def _above_in_rows(cut: NeckCut, rays: _Rays, rows: range) -> Float[np.ndarray, "r w"]:
    start = rays.start
    x = np.arange(rays.width, dtype=np.float32)[None] + 0.5
    y = np.asarray(rows, dtype=np.float32)[:, None] + 0.5
    # Rays in the cylinder's frame, of depth 1 along the camera's axis, scaled so that the ellipse is a unit circle.
    dx, dy, dz = ((row[0] * x + row[1] * y + row[2]).astype(np.float32) for row in rays.turned)
    px, py = start[:2] / cut.radii
    dx, dy = dx / np.float32(cut.radii[0]), dy / np.float32(cut.radii[1])
    a = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
    half = px * dx + py * dy
    nearest = -half / a
    miss = np.maximum(px * px + py * py - half * half / a, 0)
    depth = nearest - np.sqrt(np.maximum(1 - miss, 0) / a)
    height = start[2] + depth * dz
    radius = float(np.sqrt(cut.radii[0] * cut.radii[1]))
    pixel = np.maximum(depth, np.float32(1e-6)) / rays.focal
    beside = radius * (_BESIDE - np.sqrt(miss)) + _SLOPE * height
    return (np.clip(height / pixel + 0.5, 0, 1) * np.clip(beside / pixel + 0.5, 0, 1)).astype(np.float32)
