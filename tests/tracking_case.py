"""Make a synthetic capture with known truth for tests of tracking: a small head in motion, as landmarks only."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face import FaceModel, FaceParams
from mien.tracking.fitting.parameters import layout_of
from small_face_model import make_small_face_model

FOCAL, SIZE, FPS = 768.0, 512, 25.0


@dataclass(frozen=True)
class TrackingCase:
    model: FaceModel
    face: FaceParams
    camera: Camera
    pixels: Tensor
    capture: Capture


def make_tracking_case(timesteps: int = 60, noise: float = 0.3, missing: tuple[int, ...] = ()) -> TrackingCase:
    """Return a case with float64 truth. `noise` is the standard deviation of each landmark coordinate in pixels."""
    random = torch.Generator().manual_seed(1)
    model = make_small_face_model().to(torch.zeros((), dtype=torch.float64))
    layout = layout_of(model)
    time = torch.arange(timesteps, dtype=torch.float64) / FPS
    state = torch.zeros(timesteps, layout.size, dtype=torch.float64)
    motions = ((0.15, 2.0), (0.35, 1.3), (0.1, 0.7), (0.03, 1.0), (0.02, 1.1), (0.05, 0.9))
    for column, (size, speed) in enumerate(motions):
        state[:, column] = size * (speed * time).sin()
    state[:, 5] -= 0.9
    for index in range(len(layout.expression_index)):
        state[:, 6 + index] = 0.45 + 0.45 * ((2 + 0.5 * index) * time + index).sin()
    for index in range(len(layout.joint_index)):
        vertical = index % 2 == 0
        state[:, 6 + len(layout.expression_index) + index] = (0.1 if vertical else 0.2) * ((2 + vertical) * time).sin()
    identity = torch.randn(len(model.identity_basis), generator=random, dtype=torch.float64)
    face = layout.face_params(state, identity)
    camera = still_camera()
    pixels = camera.project(model.landmark_positions(model(face), "mediapipe"))[0]
    seen = pixels + noise * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
    return TrackingCase(model, face, camera, pixels, capture_of(seen, missing))


def still_camera() -> Camera:
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)), SIZE, SIZE)


def capture_of(pixels: Tensor, missing: tuple[int, ...] = (), cameras: int = 1) -> Capture:
    landmarks = pixels.numpy().astype(np.float32)[:, None].repeat(cameras, axis=1)
    valid = np.ones(landmarks.shape[:2], bool)
    valid[list(missing)] = False
    landmarks[~valid] = np.nan
    shape = (*valid.shape, SIZE, SIZE)
    return Capture(
        name="case", camera_ids=tuple(str(index) for index in range(cameras)), fps=FPS,
        timestamps=np.arange(len(landmarks)) / FPS, images=np.full((*shape, 3), 128, np.uint8),
        mattes=np.full(shape, 255, np.uint8), landmarks=landmarks, valid=valid,
        principal_point=np.full((cameras, 2), SIZE / 2, np.float32), source={},
    )  # fmt: skip
