"""How well a torso is tracked, and how still it stands while the head turns."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.avatar.avatar import Avatar
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.face.torso import still_torso, torso_pose
from mien.lab.synthetic.truth import Truth
from mien.render import rasterize
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking.tracking import Tracking

_SIDE, _UNIT = 2048, 512
"""Longer sides of the pictures whose outlines are compared, and of those in whose pixels motion is given."""
_TURNS = np.radians(np.linspace(-20, 20, 9))


@dataclass(frozen=True)
class TorsoErrors:
    """Root mean squares over the tracked timesteps, of a face model with a torso."""

    turn_deg: tuple[float, float, float]
    """Errors of the torso's rotation about its axes: nod, turn and tilt, in degrees."""
    turn_steady_deg: tuple[float, float, float]
    """The same without their mean, in which the shape of clothes and the pose can compensate for each other."""
    place_percent: float
    """Error of the base of the neck in the picture, without its mean, in percent of the shoulders' width."""


def crop_landmarks(landmarks: Float[np.ndarray, "t c l 2"], capture: Capture) -> Float[np.ndarray, "t c l 2"]:
    """Convert pixels of the drawn pictures to pixels of the capture, which may be cropped and shrunk."""
    crop = capture.source.get("crop")
    if crop is None:
        return landmarks
    scale = np.array([capture.width / crop["width"], capture.height / crop["height"]], np.float32)
    return (landmarks - np.array([crop["left"], crop["top"]], np.float32)) * scale


def torso_errors(tracking: Tracking, capture: Capture, truth: Truth, face_model: FaceModel) -> TorsoErrors:
    """Compare the torsos of a tracking with the shoulders that were drawn, as the first camera sees them."""
    kept, true, found = tracking.valid, truth.torso, torso_pose(face_model, tracking.face)
    turned = matrix_from_axis_angle(true.rotation).mT @ matrix_from_axis_angle(found.rotation)
    off = torch.rad2deg(axis_angle_from_matrix(turned))[kept]
    pairs = ((tracking.cameras, found), (truth.tracking.cameras, true))
    ours, theirs = (cameras[0].project(pose.translation)[0].numpy() for cameras, pose in pairs)
    away = torch.from_numpy(ours - crop_landmarks(theirs[:, None, None], capture)[:, 0, 0])[kept]
    marks = face_model.landmark_positions(face_model(tracking.face), "shoulders")
    left, _, right, _ = tracking.cameras[0].project(marks.reshape(-1, 3))[0].reshape(len(marks), 4, 2).unbind(1)
    width = (left - right).norm(dim=1).median()
    place = 100 * (away - away.mean(0)).square().sum(1).mean().sqrt() / width
    return TorsoErrors(_three(off), _three(off - off.mean(0)), float(place))


def _three(values: Float[torch.Tensor, "t 3"]) -> tuple[float, float, float]:
    x, y, z = values.square().mean(0).sqrt().tolist()
    return x, y, z


@torch.no_grad()
def outline_motion(avatar: Avatar, rest: FaceParams, camera: Camera) -> float | None:
    """Median motion of the shoulders' outline while the head alone turns by up to 20 degrees to each side.

    It is in pixels of a picture of 512x512, over the outline's pixels below the base of the neck. The head turns from
    `rest`, a single timestep of an avatar with a torso. None if the picture ends above the shoulders.
    """
    model = avatar.face_model
    scale = _SIDE / max(camera.width, camera.height)
    camera = camera.resized(round(scale * camera.width), round(scale * camera.height))
    below = max(0, round(float(camera.project(torso_pose(model, rest).translation)[0][0, 1])))

    def outline(face_turn: float) -> Bool[np.ndarray, "h w"]:
        turn = matrix_from_axis_angle(torch.tensor([[0.0, face_turn, 0.0]]))
        turned = axis_angle_from_matrix(matrix_from_axis_angle(rest.head_rotation) @ turn)
        gaussians = avatar.pose(still_torso(model, replace(rest, head_rotation=turned), rest)).gaussians.timestep(0)
        shown = (rasterize(gaussians, camera, torch.ones(3)).alpha > 0.5).numpy().astype(np.uint8)
        return (shown > cv2.erode(shown, np.ones((3, 3), np.uint8)))[below:]

    still = outline(0.0)
    if not still.any():
        return None
    away = cv2.distanceTransform((~still).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    moved = np.concatenate([away[outline(turn)] for turn in _TURNS.tolist()])
    return float(np.median(moved)) * _UNIT / _SIDE
