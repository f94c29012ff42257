"""Draw a small textured head in motion: pictures with known truth for tests of the fit to pixels."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face import FaceModel, FaceParams
from mien.render.mesh import Texture, render_mesh
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.tracking import Tracking
from small_face_model import make_small_face_model
from tracking_case import capture_of

SIZE, FOCAL = 128, 230.0
_SHARPER = 3
"""Factor by which pictures are drawn larger before they are shrunk."""


@dataclass(frozen=True)
class PhotometricCase:
    model: FaceModel
    face: FaceParams
    camera: Camera
    landmarks: Tensor
    """True positions in pixels."""
    capture: Capture


def make_textured_model() -> FaceModel:
    """Return the model of `make_small_face_model` with texture coordinates; front and back are side by side."""
    model = make_small_face_model()
    front = torch.stack([0.25 + 2.5 * model.template[:, 0], 0.5 + 3.5 * model.template[:, 1]], dim=-1)
    behind = model.template[model.faces].mean(1)[:, 2] < 0
    uv = torch.cat([front, front + torch.tensor([0.5, 0.0])])
    return replace(model, uv=uv, uv_faces=model.faces + len(front) * behind[:, None])


def smooth_noise(height: int, width: int, blur: float, seed: int = 3) -> Tensor:
    """Return colours of 0.15..0.85 in blots of about `blur` texels."""
    noise = np.random.default_rng(seed).standard_normal((height, width, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), blur)
    return torch.from_numpy(np.clip(0.5 + 0.15 * noise / noise.std(), 0.15, 0.85))


def make_photometric_case(timesteps: int = 16, shake: float = 0.5) -> PhotometricCase:
    """Draw the head.
    Its landmarks err like a detector's: together by up to `shake` pixels per frame, and each by a little."""
    model = make_textured_model()
    layout = layout_of(model)
    time = torch.arange(timesteps, dtype=torch.float64) / 25
    state = torch.zeros(timesteps, layout.size, dtype=torch.float64)
    for column, (size, speed) in enumerate(((0.12, 2.0), (0.25, 1.5), (0.05, 0.7), (0.01, 1.0), (0.01, 1.1))):
        state[:, column] = size * (speed * time).sin()
    state[:, 5] = -0.6
    for index in range(len(layout.expression_index)):
        state[:, 6 + index] = 0.45 + 0.45 * ((2 + 0.5 * index) * time + index).sin()
    face = layout.face_params(state, torch.linspace(-1, 1, len(model.identity_basis), dtype=torch.float64))
    face = face.to(torch.zeros(()))
    camera = Camera(
        torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]),
        torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), SIZE, SIZE,
    )  # fmt: skip
    vertices = model(face)
    texture = Texture(smooth_noise(256, 256, 4.0), model.uv[model.uv_faces])
    drawn = [_draw(model, mesh, texture, camera) for mesh in vertices]
    marks = camera.project(model.landmark_positions(vertices, "mediapipe"))[0]
    random = torch.Generator().manual_seed(1)
    common = torch.randn(len(marks), 1, 2, generator=random)
    seen = marks + shake * (common + 0.2 * torch.randn(marks.shape, generator=random))
    capture = replace(
        capture_of(seen), images=np.stack([image for image, _ in drawn])[:, None],
        mattes=np.stack([matte for _, matte in drawn])[:, None],
        principal_point=np.full((1, 2), SIZE / 2, np.float32),
    )  # fmt: skip
    return PhotometricCase(model, face, camera, marks, capture)


def assert_alike(expected: Tracking, found: Tracking) -> None:
    """Check that two results are the same to the bit."""
    for name, tensor in expected.face.tensors().items():
        assert torch.equal(tensor, found.face.tensors()[name]), name
    for name in ("residuals", "pixel_residuals"):
        one, other = getattr(expected, name), getattr(found, name)
        assert torch.equal(one.nan_to_num(-1), other.nan_to_num(-1)), name
    assert expected.appearance is not None
    assert found.appearance is not None
    for name in ("texture", "trust", "light"):
        assert torch.equal(getattr(expected.appearance, name), getattr(found.appearance, name)), name
    assert torch.equal(expected.cameras[0].K, found.cameras[0].K)


def _draw(model: FaceModel, vertices: Tensor, texture: Texture, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    image, alpha = render_mesh(
        vertices, model.faces, camera, texture, background=(0.3, 0.3, 0.3), supersample=_SHARPER
    )  # fmt: skip
    picture = torch.cat([image, alpha[..., None]], dim=-1).numpy()
    picture = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    return picture[..., :3], picture[..., 3]
