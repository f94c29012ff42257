"""Make a face model that is small enough to reason about: an open ellipsoid, two eyeballs, random smooth bases."""

import math

import torch
from torch import Tensor

from mien.face import FaceModel
from mien.face.model import Landmarks
from mien.tracking.landmarks.groups import LEFT_IRIS, RIGHT_IRIS
from toy_scene import sphere


def make_small_face_model(identities: int = 6, expressions: int = 8, seed: int = 0) -> FaceModel:
    """Return a model of about 750 vertices, with landmarks, irises, and a first expression that turns a jaw joint."""
    random = torch.Generator().manual_seed(seed)
    skull, skull_faces = sphere(24, 28, kept=21, margin=0.05)  # open below
    skull = skull * torch.tensor([0.075, 0.11, 0.095])
    ball, ball_faces = sphere(8, 10, margin=0.05)
    centers = torch.tensor([[0.032, 0.02, 0.075], [-0.032, 0.02, 0.075]])
    template = torch.cat([skull, *(ball * 0.013 + center for center in centers)])
    offsets = (0, len(skull), len(skull) + len(ball))
    faces = torch.cat([skull_faces + offsets[0], ball_faces + offsets[1], ball_faces + offsets[2]])
    regions = (torch.arange(len(faces)) >= len(skull_faces)).long()
    weights = torch.zeros(len(template), 5)
    jaw = torch.sigmoid((-0.03 - skull[:, 1]) * 100) * torch.sigmoid((skull[:, 2] - 0.04) * 200)
    neck = torch.sigmoid((-0.08 - skull[:, 1]) * 200) * (skull[:, 2] <= 0)
    weights[: len(skull), 0] = 1 - jaw - neck
    weights[: len(skull), 1], weights[: len(skull), 4] = neck, jaw
    weights[offsets[1] : offsets[2], 2] = 1
    weights[offsets[2] :, 3] = 1
    moved = torch.zeros(len(template))
    moved[: len(skull)] = torch.sigmoid(skull[:, 2] * 200)
    rotation_basis = torch.zeros(expressions, 5, 3)
    rotation_basis[0, 4, 0] = 0.25
    bounds = torch.tensor([[0.0, 1.0]]).repeat(expressions, 1)
    bounds[-1] = 0
    joints = torch.cat([torch.tensor([[0.0, 0, 0], [0, -0.08, -0.03]]), centers, torch.tensor([[0.0, -0.02, 0.0]])])
    return FaceModel(
        name="small", template=template, faces=faces, uv=torch.zeros(len(template), 2), uv_faces=faces,
        region_names=("skin", "eyes"), face_regions=regions,
        identity_basis=_smooth_basis(template, identities, 0.003, random),
        expression_basis=_smooth_basis(template, expressions, 0.006, random) * moved[:, None],
        expression_names=tuple(f"move{index}" for index in range(expressions)), expression_bounds=bounds,
        joint_names=("head", "neck", "left_eye", "right_eye", "jaw"), joint_parents=(-1, 0, 0, 0, 0),
        joint_free=(False, True, True, True, False), joint_template=joints,
        joint_identity_basis=torch.randn(identities, 5, 3, generator=random) * 0.001,
        joint_rotation_basis=rotation_basis, joint_translation_basis=torch.zeros(expressions, 5, 3),
        skinning_weights=weights, landmarks={"mediapipe": _landmarks(template, faces, regions, random)},
    )  # fmt: skip


def _landmarks(template: Tensor, faces: Tensor, regions: Tensor, random: torch.Generator) -> Landmarks:
    middle = template[faces].mean(1)
    front = ((regions == 0) & (middle[:, 2] > 0.03) & (middle[:, 1].abs() < 0.09)).nonzero()[:, 0]
    chosen = front[torch.randint(len(front), (478,), generator=random)]
    for iris, side in ((LEFT_IRIS, 1), (RIGHT_IRIS, -1)):
        eyeball = (regions == 1) & (middle[:, 0] * side > 0)
        nearest = torch.where(eyeball, middle[:, 2], -torch.inf).topk(len(iris)).indices
        chosen[list(iris)] = nearest
    barycentric = torch.rand(478, 3, generator=random) + 0.1
    return Landmarks(chosen, barycentric / barycentric.sum(1, keepdim=True))


def _smooth_basis(points: Tensor, count: int, size: float, random: torch.Generator) -> Tensor:
    """Return random waves that move neighbours alike. None of them moves the face as a whole, as the head pose does."""
    waves = torch.randn(count, 4, 3, generator=random) * 40
    phases = torch.rand(count, 4, generator=random) * 2 * math.pi
    amounts = torch.randn(count, 4, 3, generator=random) * size / 2
    basis = torch.einsum("cwv,cwa->cva", (waves @ points.T + phases[..., None]).sin(), amounts)
    motions = [axis.expand_as(points) for axis in torch.eye(3)]
    motions += [torch.linalg.cross(axis.expand_as(points), points) for axis in torch.eye(3)] + [points]
    rigid = torch.stack([motion.flatten() for motion in motions], dim=1)
    seen = (points[:, 2:] > 0.03).expand_as(points).flatten()
    amount = torch.linalg.lstsq(rigid[seen], basis.flatten(1).T[seen]).solution
    return basis - (rigid @ amount).T.reshape(basis.shape)
