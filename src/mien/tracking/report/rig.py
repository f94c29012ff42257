"""How several calibrated cameras see a tracked head: which look at the face, what they see, and which do not fit."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Camera
from mien.capture.cameras.readings import advice_of, is_wrong, rank_readings, readings_of
from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.render.mesh import vertex_normals
from mien.rotation import matrix_from_axis_angle
from mien.tracking.tracking import Tracking

_SIDEWAYS = 0.8
"""Angle in radians between the face's direction and a camera from which pictures count as taken from the side: 45
degrees. The detector guesses the far half of such a face."""
_FACTOR, _SHARE = 3.0, 0.01
"""A camera does not fit if it misplaces the face this many times as far as the others do, and in addition by this part
of its picture's longer side."""
_MISFIT, _SUSPECT = 0.02, 0.01
"""Median distance of landmarks, as a share of the face's side, from which a calibration as a whole does not fit, and
from which it does not if another reading of it fits far better."""


def seen_from_front(tracking: Tracking) -> Bool[Tensor, "t c"]:
    """Pictures in which the face looks roughly at the camera. With one camera, all of them."""
    face, cameras = tracking.face, tracking.cameras
    if len(cameras) == 1:
        return torch.ones(tracking.residuals.shape, dtype=torch.bool)
    ahead = matrix_from_axis_angle(face.head_rotation)[:, :, 2]
    sights = torch.stack([camera.position.to(ahead) - face.head_translation for camera in cameras], 1)
    cosines = (ahead[:, None] * sights).sum(-1) / sights.norm(dim=-1)
    return cosines.clamp(-1, 1).acos() < _SIDEWAYS


def front_residuals(tracking: Tracking) -> Float[Tensor, "t c"]:
    """Residuals of landmarks. They are NaN in pictures from the side, unless a timestep has no other."""
    front = seen_from_front(tracking) & tracking.residuals.isfinite()
    return tracking.residuals.where(front | ~front.any(1, keepdim=True), torch.nan)


@torch.no_grad()
def visible_landmarks(face_model: FaceModel, vertices: Float[Tensor, "*b v 3"], camera: Camera) -> Bool[Tensor, "*b l"]:
    """MediaPipe's landmarks on the side of the head that faces the camera."""
    points = face_model.landmark_positions(vertices, "mediapipe")
    normals = face_model.landmark_positions(vertex_normals(vertices, face_model.faces), "mediapipe")
    return (normals * (camera.position.to(points) - points)).sum(-1) > 0


@torch.no_grad()
def misplacements(capture: Capture, tracking: Tracking, face_model: FaceModel) -> Float[Tensor, " c"]:
    """Distance in pixels by which each camera sees the face beside the tracked one; NaN if it never finds a face.

    It is the median over pictures of how far the visible landmarks lie off together. Landmarks that slide along the
    face, or are guessed, hardly change it; a wrong matrix moves all of them.
    """
    detected = torch.from_numpy(np.asarray(capture.landmarks, dtype=np.float32))
    shifts: list[list[Tensor]] = [[] for _ in tracking.cameras]
    for start in range(0, len(tracking.face), 32):
        part = slice(start, start + 32)
        vertices = face_model(tracking.face[part])
        marks = face_model.landmark_positions(vertices, "mediapipe")
        for index, camera in enumerate(tracking.cameras):
            apart = detected[part, index] - camera.project(marks)[0]
            apart[~visible_landmarks(face_model, vertices, camera)] = torch.nan
            shifts[index].append(apart.nanmedian(1).values.norm(dim=-1))
    return torch.stack([torch.cat(own).nanmedian() for own in shifts])


def cameras_that_do_not_fit(misplaced: Float[Tensor, " c"], longer_side: int) -> list[tuple[int, float]]:
    """Cameras that see the face far from where the others see it: each index, with the others' median distance."""
    found = []
    for index, distance in enumerate(misplaced.tolist()):
        others = torch.cat([misplaced[:index], misplaced[index + 1 :]])
        usual = float(others.nanmedian()) if len(others) else float("nan")
        if distance > _FACTOR * usual + _SHARE * longer_side:
            found.append((index, usual))
    return found


def shared_misfit(capture: Capture, tracking: Tracking) -> dict[str, float | str] | None:
    """Return how badly all cameras together fit the tracked head, and advice; None if they fit.

    No camera stands out if the calibration of all of them is misread. Their residuals are then far above the noise of
    the detector, which is 0.5 to 1 % of the face's side.
    """
    if capture.calibration is None or len(capture.calibration) == 1:
        return None
    residuals = front_residuals(tracking)
    spans = np.ptp(np.asarray(capture.landmarks, np.float64), axis=2)
    sides = torch.from_numpy(np.sqrt(spans.prod(axis=-1))).to(residuals)
    share = float((residuals / sides).nanmedian())
    if not share > _SUSPECT:
        return None
    ranked = rank_readings(capture.landmarks, readings_of(capture.calibration, in_source=False))
    if not (share > _MISFIT or is_wrong(ranked)):
        return None
    advice = advice_of(ranked) if is_wrong(ranked) else ""
    return {"residual_px": float(residuals.nanmedian()), "residual_share": share, "advice": advice}
