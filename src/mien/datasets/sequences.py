"""What a reader of sequences returns, made from the parts that datasets have: pictures, cameras, face parameters."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from mien.camera import Camera
from mien.capture import Capture
from mien.datasets.dataset import TrackedSequence
from mien.face import FaceModel, FaceParams
from mien.tracking import Tracking, fit_neck_lines

_LANDMARKS = "mediapipe"
_CHUNK = 32
"""Number of timesteps posed at once."""


@torch.no_grad()
def tracked_sequence(
    name: str,
    images: UInt8[np.ndarray, "t c h w 3"],
    mattes: UInt8[np.ndarray, "t c h w"],
    cameras: Mapping[str, Camera],
    face_model: FaceModel,
    face: FaceParams,
    fps: float,
    source: Mapping[str, Any],
) -> TrackedSequence:
    """Return a sequence whose every frame is tracked.

    Landmarks are those of the face model, projected, because no dataset has the points of mien's detector. Residuals
    are therefore 0, and training and scoring do not read landmarks.

    Args:
        name: Name of the sequence.
        images: Decoded sRGB pixels. They may be a memory map.
        mattes: Opacity of the person; 255 is the person.
        cameras: Each camera by its id, in the order of the axis c, in one world, for pictures of this size.
        face_model: The face model of the parameters.
        face: The person at the t timesteps, in the cameras' world.
        fps: Frames per second.
        source: What the sequence was read from, for people: the file, and what the dataset says of itself.
    """
    views, frames = tuple(cameras.values()), mattes.shape[:2]
    capture = Capture(
        name=name,
        camera_ids=tuple(cameras),
        fps=fps,
        timestamps=np.arange(len(mattes)) / fps,
        images=images,
        mattes=mattes,
        landmarks=_landmarks(face_model, face, views),
        valid=np.ones(frames, bool),
        principal_point=np.stack([camera.K[:2, 2].double().numpy() for camera in views]),
        source=dict(source),
        calibration=views,
    )
    tracking = Tracking(
        face_model=face_model.name,
        face_model_hash=face_model.content_hash,
        face=face,
        valid=torch.ones(len(mattes), dtype=torch.bool),
        cameras=views,
        neck_lines=fit_neck_lines(face_model, face, views),
        residuals=torch.zeros(frames),
    )
    return TrackedSequence(capture, tracking, face_model)


def _landmarks(face_model: FaceModel, face: FaceParams, cameras: tuple[Camera, ...]) -> Float[np.ndarray, "t c l 2"]:
    """The face model's landmarks in every picture, in pixels."""
    parts = []
    for start in range(0, len(face), _CHUNK):
        points = face_model.landmark_positions(face_model(face[start : start + _CHUNK]), _LANDMARKS)
        parts.append(torch.stack([camera.project(points)[0] for camera in cameras], dim=1))
    return torch.cat(parts).numpy()
