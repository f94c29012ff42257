"""Make a face model of about a hundred vertices and a tiny capture of it, for fast training tests."""

import math

import numpy as np
import torch
from torch import Tensor

from mien.avatar import Avatar
from mien.avatar.bound_surface import BoundSurface
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face import FaceModel, FaceParams
from mien.gaussians import SH_C0
from mien.runtime.posing import Face
from mien.tracking.tracking import Tracking
from mien.training import TrainSettings
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Sequence, Targets
from mien.training.trainer import TrainingData


def random(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def rgb_from_sh(dc: Tensor) -> Tensor:
    """Colours of constant SH coefficients [..., 3], clamped to 0 from below as in the renderers."""
    return torch.clamp_min(dc * SH_C0 + 0.5, 0)


def toy_face_model(rings: int = 9, around: int = 12) -> FaceModel:
    """Return an ellipsoid head with two expressions (dropped lower half, swollen front), a neck and a derived jaw."""
    template, faces = sphere(rings, around)
    template = template * torch.tensor([0.08, 0.11, 0.09])
    v = len(template)
    low = torch.sigmoid((-template[:, 1] - 0.02) * 80)
    front = torch.sigmoid((template[:, 2] - 0.03) * 80)
    expression = torch.zeros(2, v, 3)
    expression[0, :, 1] = -0.03 * low
    expression[1, :, 2] = 0.02 * front
    weights = torch.zeros(v, 3)
    weights[:, 2] = low * front
    weights[:, 1] = 0.5 * low * (1 - front)
    weights[:, 0] = 1 - weights[:, 1] - weights[:, 2]
    identity = torch.zeros(2, v, 3)
    identity[0, :, 0] = 0.1 * template[:, 0]
    identity[1, :, 1] = 0.1 * template[:, 1]
    rotation = torch.zeros(2, 3, 3)
    rotation[0, 2, 0] = 0.2
    return FaceModel(
        name="toy", template=template, faces=faces, uv=torch.zeros(v, 2), uv_faces=faces,
        region_names=("skin",), face_regions=torch.zeros(len(faces), dtype=torch.long),
        identity_basis=identity, expression_basis=expression, expression_names=("drop", "swell"),
        expression_bounds=torch.tensor([[0.0, 1.0], [0.0, 1.0]]),
        joint_names=("head", "neck", "jaw"), joint_parents=(-1, 0, 0), joint_free=(False, True, False),
        joint_template=torch.tensor([[0.0, 0, 0], [0, -0.08, -0.02], [0, -0.02, 0]]),
        joint_identity_basis=torch.zeros(2, 3, 3), joint_rotation_basis=rotation,
        joint_translation_basis=torch.zeros(2, 3, 3), skinning_weights=weights, landmarks={},
    )  # fmt: skip


def toy_face(timesteps: int) -> FaceParams:
    """Return a head half a metre in front of the camera that talks, nods and turns a little."""
    time = torch.linspace(0, 2 * math.pi, timesteps + 1)[:-1]
    still = torch.zeros(timesteps)
    return FaceParams(
        identity=torch.tensor([0.5, -0.3]),
        expression=torch.stack([0.5 + 0.5 * time.sin(), 0.5 - 0.5 * time.cos()], dim=-1),
        joints=0.1 * torch.stack([time.cos(), still, still], dim=-1)[:, None],
        head_rotation=torch.stack([0.1 * time.sin(), 0.2 * time.cos(), still], dim=-1),
        head_translation=torch.stack([0.01 * time.cos(), 0.01 * time.sin(), still - 0.5], dim=-1),
    )


def runtime_face(face: FaceParams) -> Face:
    fields = (face.expression, face.joints, face.head_rotation, face.head_translation)
    return Face(*(tensor[0].detach().numpy() for tensor in fields))


def toy_camera(size: int) -> Camera:
    """Return a camera in a world with y up and z backward, in which the head fills half of the picture."""
    focal = 1.2 * size
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), size, size)


def toy_tracking(face_model: FaceModel, timesteps: int, size: int) -> Tracking:
    """Return the exact tracking of the toy capture."""
    return Tracking(
        face_model=face_model.name, face_model_hash=face_model.content_hash, face=toy_face(timesteps),
        valid=torch.ones(timesteps, dtype=torch.bool), cameras=(toy_camera(size),),
        neck_lines=torch.tensor([0.0, -1.0, float(size)]).repeat(timesteps, 1, 1),
        residuals=torch.zeros(timesteps, 1),
    )  # fmt: skip


def toy_capture(face_model: FaceModel, timesteps: int = 10, size: int = 64) -> tuple[Capture, np.ndarray]:
    """Return pictures of coloured blobs at the mesh's triangles, with their alpha as the scoring mask."""
    camera, face = toy_camera(size), toy_face(timesteps)
    vertices = face_model(face)
    rows = torch.arange(size) + 0.5
    colors = 0.5 + 0.5 * torch.sin(40 * face_model.template[face_model.faces].mean(1) + torch.tensor([0.0, 2.0, 4.0]))
    images, mattes = [], []
    for timestep in range(timesteps):
        centers = vertices[timestep][face_model.faces].mean(1)
        facing = _facing(vertices[timestep], face_model.faces)
        pixels, _ = camera.project(centers)
        squared = (rows[None, :, None] - pixels[:, 0]) ** 2 + (rows[:, None, None] - pixels[:, 1]) ** 2
        weights = torch.exp(-squared / (2 * (size / 25) ** 2)) * facing
        total = weights.sum(-1)
        image = (weights[..., None] * colors).sum(-2) / total.clamp_min(1e-6)[..., None]
        images.append((image * 255).to(torch.uint8))
        mattes.append(((total * 2).clamp_max(1) * 255).to(torch.uint8))
    pictures, alpha = torch.stack(images)[:, None].numpy(), torch.stack(mattes)[:, None].numpy()
    capture = Capture(
        name="toy", camera_ids=("front",), fps=25.0, timestamps=np.arange(timesteps) / 25, images=pictures,
        mattes=alpha, landmarks=np.zeros((timesteps, 1, 478, 2), dtype=np.float32),
        valid=np.ones((timesteps, 1), dtype=bool), principal_point=np.full((1, 2), size / 2, dtype=np.float32),
        source={"file": "toy"},
    )  # fmt: skip
    return capture, alpha


def toy_sequence(timesteps: int = 10, size: int = 48) -> tuple[FaceModel, Sequence]:
    face_model = toy_face_model()
    capture, alpha = toy_capture(face_model, timesteps, size)
    return face_model, Sequence("toy", capture, toy_tracking(face_model, timesteps, size), alpha)


def toy_data(sequence: Sequence, settings: TrainSettings, like: Tensor | None = None) -> TrainingData:
    """Return the pictures of a sequence in the order of a training."""
    order = FrameOrder(training_frames([sequence], settings), settings.seed)
    targets = Targets(sequence, settings.resolution, like=torch.zeros(()) if like is None else like)
    return TrainingData(order, (targets,))


def moved(avatar: Avatar, size: float, but: str = " ") -> Avatar:
    """Return the avatar, whose parameters get random changes of this size, but for those whose names end so."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in avatar.named_parameters():
            if not name.endswith(but):
                parameter.add_(size * torch.randn(parameter.shape, generator=generator))
    return avatar


def surface_of(avatar: Avatar) -> BoundSurface:
    surface = avatar.extras.surface
    assert surface is not None
    return surface


def _facing(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return 1 for triangles whose outside the camera sees, and 0 for others."""
    v0, v1, v2 = vertices[faces].unbind(1)
    return ((torch.linalg.cross(v1 - v0, v2 - v0) * (v0 + v1 + v2)).sum(-1) < 0).float()


def sphere(rings: int, around: int, kept: int = -1, margin: float = 0.15) -> tuple[Tensor, Tensor]:
    """Return the vertices of a unit sphere of rings from top to bottom, and its triangles.
    Only the first rings are kept if there are more. The holes at its poles have a radius of `margin`."""
    polar = torch.linspace(margin, math.pi - margin, rings)[:, None][: kept if kept > 0 else rings]
    angle = torch.linspace(0, 2 * math.pi, around + 1)[:-1]
    x, z = polar.sin() * angle.sin(), polar.sin() * angle.cos()
    points = torch.stack([x, polar.cos().expand_as(x), z], dim=-1).reshape(-1, 3)
    ring, column = torch.meshgrid(torch.arange(len(polar) - 1), torch.arange(around), indexing="ij")
    first, second = ring * around + column, ring * around + (column + 1) % around
    quads = torch.stack([first, first + around, second + around, first, second + around, second], dim=-1)
    return points, quads.reshape(-1, 3)
