"""The first stage of tracking: the rotation and translation of the head, fitted at each timestep alone."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.rotation import axis_angle_from_matrix
from mien.tracking.fitting.fit import Subject
from mien.tracking.fitting.parameters import pose_only
from mien.tracking.fitting.solver import minimize_frames
from mien.tracking.fitting.views import CameraBatch, Views
from mien.tracking.landmarks.groups import rigid_weights
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.term import LandmarkTerm, landmark_term
from mien.tracking.settings import TrackingSettings

FIRST_OUTLIER = 40.0  # outlier threshold of the first head pose, in standard deviations
_POSE_ITERATIONS = 15  # number of iterations of the first head pose


def fit_head_pose(
    model: LandmarkModel, views: Views, cameras: CameraBatch, subject: Subject, settings: TrackingSettings
) -> Float[Tensor, "v 6"]:
    """Fit head rotation and translation at each timestep alone, from landmarks that expressions hardly move.

    Each picture is fitted by itself first, starting from a head that faces its camera. If several cameras see a
    timestep, their joint fit starts from the one of these poses that suits all of them best.
    """
    weights = rigid_weights()
    rigid = (weights > 0).nonzero()[:, 0]
    model = model.at(rigid, pose_only(model.layout))
    views, weights = views.of_landmarks(rigid), weights[rigid]
    subject = replace(subject, bias=subject.bias[rigid])
    at_rest = model.layout.face_params(views.detected.new_zeros(1, 6), subject.identity)
    points = model.head_points(at_rest, subject.bias)[0][0]
    alone = views.apart()
    start = _facing_the_cameras(points, alone.detected, cameras[alone.camera])
    poses = _minimize(_wide(model, alone, weights, start, cameras, settings), start, subject, cameras)
    if len(poses) == views.rows:
        return poses
    term = _wide(model, views, weights, poses[_first_picture(views)], cameras, settings)
    return _minimize(term, _best_for_all(term, poses, subject, cameras), subject, cameras)


def _wide(
    model: LandmarkModel,
    views: Views,
    weights: Float[Tensor, " l"],
    state: Float[Tensor, "v 6"],
    cameras: CameraBatch,
    settings: TrackingSettings,
) -> LandmarkTerm:
    term = landmark_term(model, views, weights, state, cameras, settings)
    return replace(term, outlier=FIRST_OUTLIER)


def _minimize(
    term: LandmarkTerm, start: Float[Tensor, "v 6"], subject: Subject, cameras: CameraBatch
) -> Float[Tensor, "v 6"]:
    layout = term.model.layout
    return minimize_frames(
        lambda state: term.equations(state, subject, cameras), lambda state: term.cost(state, subject, cameras),
        start, layout.bounds, _POSE_ITERATIONS,
    )  # fmt: skip


def _facing_the_cameras(
    points: Float[Tensor, "l 3"], detected: Float[Tensor, "n l 2"], cameras: CameraBatch
) -> Float[Tensor, "n 6"]:
    """Head poses that look straight into each picture's camera and match the size and place of the detected points."""
    center = detected.mean(1)
    spread = (detected - center[:, None]).norm(dim=-1).mean(1)
    focal = cameras.K[:, 0, 0]
    depth = focal * (points - points.mean(0))[:, :2].norm(dim=-1).mean() / spread
    across = (center - cameras.K[:, :2, 2]) / focal[:, None] * depth[:, None]
    in_camera = torch.cat([across, depth[:, None]], dim=1)
    R_world_camera = cameras.viewmat[:, :3, :3].mT
    in_world = (R_world_camera @ (in_camera - cameras.viewmat[:, :3, 3])[..., None])[..., 0]
    R_world_head = R_world_camera @ torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(points)
    return torch.cat([axis_angle_from_matrix(R_world_head), in_world - R_world_head @ points.mean(0)], dim=1)


def _first_picture(views: Views) -> Tensor:
    """The index of the first picture of each timestep."""
    first = torch.zeros(views.rows, dtype=torch.long)
    first[views.row.flip(0)] = torch.arange(len(views.row) - 1, -1, -1)
    return first


def _best_for_all(
    term: LandmarkTerm, poses: Float[Tensor, "n 6"], subject: Subject, cameras: CameraBatch
) -> Float[Tensor, "v 6"]:
    """For each timestep, the pose that fits all of its pictures best, out of the poses fitted to single pictures."""
    views = term.views
    best = poses[_first_picture(views)]
    lowest = term.cost(best, subject, cameras)
    for camera in views.camera.unique():
        own = views.camera == camera
        candidate = best.clone()
        candidate[views.row[own]] = poses[own]
        cost = term.cost(candidate, subject, cameras)
        better = cost < lowest
        best, lowest = torch.where(better[:, None], candidate, best), torch.where(better, cost, lowest)
    return best
