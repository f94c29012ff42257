"""Lines through the base of a tracked neck, in space and in pictures. Also the vertices of the neck."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from mien.camera import Camera
from mien.face.model import FaceModel
from mien.face.params import FaceParams

_MIDDLE = (0.4, 0.7)  # range of the middle of the neck, as shares of the way from its base to its top. Set by eye
_BATCH = 32  # number of timesteps posed at once
_REACH = 0.1  # distance along a direction in space at which it is projected, in metres
_STEEPEST = 0.7  # least sine of the angle between line and neck in a picture, about 45 degrees. Set by eye


def bottom_vertices(face_model: FaceModel) -> Int[Tensor, " n"]:
    """The vertices of the base of the neck: the mesh's lowest open boundary, or where a bust begins below it."""
    faces = face_model.faces[~face_model.region_mask("bust")]
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(dim=1).values
    unique, counts = edges.unique(dim=0, return_counts=True)
    boundary = unique[counts == 1].numpy()
    assert len(boundary), f"face model {face_model.name!r} is closed: it has no base of the neck"
    size = len(face_model.template)
    graph = coo_array((np.ones(len(boundary)), boundary.T), (size, size))
    label = torch.from_numpy(connected_components(graph, directed=False)[1])
    loops = [(label == one).nonzero()[:, 0] for one in label[boundary[:, 0]].unique()]
    return min(loops, key=lambda loop: float(face_model.template[loop, 1].mean()))


def neck_vertices(face_model: FaceModel) -> Int[Tensor, " n"]:
    """The vertices around the middle of the neck, which is a column there. Its base spreads over the shoulders.

    For a face model without a region `neck` these are the bottom vertices.
    """
    bottom = bottom_vertices(face_model)
    neck = face_model.faces[face_model.region_mask("neck")].unique()
    if len(neck) == 0:
        return bottom
    heights = face_model.template[neck, 1]
    base = face_model.template[bottom, 1].mean()
    low, high = (base + share * (heights.max() - base) for share in _MIDDLE)
    middle = neck[(heights >= low) & (heights <= high)]
    return middle if len(middle) > 0 else bottom


def fit_neck_lines(face_model: FaceModel, face: FaceParams, cameras: tuple[Camera, ...]) -> Float[Tensor, "t c 3"]:
    """Fit `Tracking.neck_lines`: in each picture, a line to the projected bottom vertices."""
    bottom = bottom_vertices(face_model)
    up = torch.tensor([0.0, _REACH, 0.0]).to(face.head_translation)
    lines = []
    for part in (face[start : start + _BATCH] for start in range(0, len(face), _BATCH)):
        vertices = face_model(part)[:, bottom]
        center = vertices.mean(1)
        above = center + part.T_world_head[:, :3, :3] @ up
        seen = [[camera.project(points)[0] for points in (vertices, center, above)] for camera in cameras]
        lines.append(torch.stack([_line(*projected) for projected in seen], dim=1))
    return torch.cat(lines)


def project_neck_line(
    vertices: Float[Tensor, "n 3"], T_world_head: Float[Tensor, "4 4"], camera: Camera
) -> Float[Tensor, " 3"]:
    """Fit one line in space across the bottom vertices, and project it: GaussianAvatars (arXiv:2312.02069), B.

    The line runs from side to side: height and depth are linear in the head's x, by least squares. Where a camera at
    the side sees it run along the neck, it goes straight across the neck there. The result is as `Tracking.neck_lines`.
    """
    R_world_head, center = T_world_head[:3, :3], vertices.mean(0)
    points = (vertices - center) @ R_world_head
    along = points[:, 0] @ points
    along, up = _REACH * (R_world_head @ along) / along.norm(), _REACH * R_world_head[:, 1]
    first, last, inside, above = camera.project(torch.stack([center - along, center + along, center, center + up]))[0]
    across = (above - inside).flip(0) * above.new_tensor([1.0, -1.0])
    if ((last - first) @ across).abs() <= _STEEPEST * (last - first).norm() * across.norm():
        first, last = inside - across, inside + across
    return _line(torch.stack([first, last])[None], inside[None], above[None])[0]


def _line(
    points: Float[Tensor, "b n 2"], inside: Float[Tensor, "b 2"], above: Float[Tensor, "b 2"]
) -> Float[Tensor, "b 3"]:
    """Total least squares lines (a, b, d), with a x + b y + d positive on the side of `above`."""
    center = points.mean(1)
    centered = points - center[:, None]
    normal = torch.linalg.eigh(centered.mT @ centered).eigenvectors[..., 0]
    upwards = ((above - inside) * normal).sum(-1, keepdim=True)
    normal = torch.where(upwards < 0, -normal, normal)
    return torch.cat([normal, -(normal * center).sum(-1, keepdim=True)], dim=1)
