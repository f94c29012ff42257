"""Faces are posed natively as by PyTorch; boxes enclose eyes and mouth; landmarks are placed exactly and repeatably."""

import json
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from known import known
from mien.camera import camera_from_fov
from mien.capture.person.faces import IBUG68
from mien.face import FaceModel, FaceParams, load_face_model, loading
from mien.face.head_parts import part_boxes
from mien.face.posing import head_poses
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.tracking.landmarks import embedding
from mien.tracking.landmarks.embedding import DetectedViews, EmbeddingSettings, best_point, embed_landmarks
from mien.tracking.landmarks.groups import LEFT_EYELIDS, RIGHT_EYELIDS
from small_face_model import make_small_face_model


def chained_model() -> FaceModel:
    """Return a model with pose correctives, a joint on a joint, translations, and shapes that move few vertices."""
    model, random = make_small_face_model(), torch.Generator().manual_seed(3)
    v = len(model.template)
    correctives = 0.01 * torch.randn(27, v, 3, generator=random) * (torch.arange(v) % 100 < 20)[:, None]
    return replace(
        model, pose_basis=correctives, joint_parents=(-1, 0, 1, 1, 0),
        joint_translation_basis=0.01 * torch.randn(8, 5, 3, generator=random),
        joint_rotation_basis=0.1 * torch.randn(8, 5, 3, generator=random),
    )  # fmt: skip


def random_face(model: FaceModel, timesteps: int, joint_scale: float = 0.5) -> FaceParams:
    """Return a face in which every field is random, with vertex offsets."""
    random, neutral = torch.Generator().manual_seed(5), model.neutral(timesteps)

    def noise(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=random)

    return FaceParams(
        noise(*neutral.identity.shape), noise(*neutral.expression.shape, scale=0.3),
        noise(*neutral.joints.shape, scale=joint_scale), noise(timesteps, 3), noise(timesteps, 3),
        noise(*model.template.shape, scale=0.001),
    )  # fmt: skip


@pytest.mark.parametrize("in_world", [True, False])
@pytest.mark.parametrize("name", ["small", "anny"])
@pytest.mark.parametrize("joint_scale", [0.5, 0.0])
def test_vertices_and_gradients_equal_the_reference(isa, name: str, in_world: bool, joint_scale: float) -> None:
    model = chained_model() if name == "small" else load_face_model("anny")
    face = random_face(model, 3, joint_scale)
    weights = torch.randn(3, *model.template.shape, generator=torch.Generator().manual_seed(6))
    results = []
    for dtype in (torch.float32, torch.float64):
        like = torch.zeros((), dtype=dtype)
        own, here = model.to(like), FaceParams(**{k: t.to(like).requires_grad_() for k, t in face.tensors().items()})
        reference = own.vertices_reference if in_world else own.head_vertices_reference
        vertices = (own(here) if in_world else own.head_vertices(here)) if dtype == torch.float32 else reference(here)
        tensors = [tensor for name, tensor in here.tensors().items() if in_world or not name.startswith("head")]
        results.append([vertices, *torch.autograd.grad((vertices * weights.to(like)).sum(), tensors)])
    for index, (ours, theirs) in enumerate(zip(*results, strict=True)):
        error = torch.linalg.vector_norm(ours.detach() - theirs.detach()) / theirs.detach().norm().clamp_min(1e-9)
        assert float(error) < 2e-5, index


def test_the_last_persons_shape_is_not_taken_for_anothers() -> None:
    model = chained_model()
    many = random_face(model, 3).detach()
    face = many[1]
    first = model(face)
    assert torch.equal(model(face), first)
    assert torch.equal(model(many)[1], first[0])
    doubled = replace(face, identity=face.identity.clone())
    model(doubled)
    doubled.identity.mul_(2)
    for other in (doubled, replace(face, identity=-face.identity), replace(face, vertex_offsets=None)):
        torch.testing.assert_close(model(other), model.vertices_reference(other), atol=1e-6, rtol=0)
    # A shape that was looked at without gradients still has them.
    shape = [face.identity.requires_grad_(), known(face.vertex_offsets).requires_grad_()]
    with torch.no_grad():
        model(face)
    for gradient in torch.autograd.grad(model(face).square().sum(), shape):
        assert gradient.any()


def test_head_poses_and_gradients_equal_the_reference() -> None:
    face = random_face(chained_model(), 7)
    rotation = torch.cat([face.head_rotation[:4], torch.tensor([[0.0, 0, 0], [1e-6, 0, 0], [3.0, 0, 1.0]])])
    translation = torch.randn(len(rotation), 3, generator=torch.Generator().manual_seed(8))
    weights = torch.randn(len(rotation), 4, 4, generator=torch.Generator().manual_seed(9))
    results = []
    for dtype in (torch.float32, torch.float64):
        leaves = [tensor.to(dtype).requires_grad_() for tensor in (rotation, translation)]
        posed = replace(face, head_rotation=leaves[0], head_translation=leaves[1])
        found = head_poses(posed) if dtype == torch.float32 else posed.T_world_head
        results.append([found, *torch.autograd.grad((found * weights.to(dtype)).sum(), leaves)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs.float(), atol=2e-6, rtol=2e-6)
    assert head_poses(face.to(torch.zeros((), dtype=torch.float64))).dtype == torch.float64


def test_more_blendshapes_than_the_core_takes_are_posed_by_the_reference() -> None:
    model = make_small_face_model()
    assert model(model.neutral(0)).shape == (0, len(model.template), 3)
    double = model.to(torch.zeros((), dtype=torch.float64))
    assert double(double.neutral()).dtype == torch.float64
    bases = ("expression_basis", "expression_bounds", "joint_rotation_basis", "joint_translation_basis")
    many = {name: torch.cat(40 * [getattr(model, name)]) for name in bases}
    names = tuple(f"e{index}" for index in range(40 * len(model.expression_names)))
    model = replace(model, **many, expression_names=names)
    face = random_face(model, 2)
    assert torch.equal(model(face), model.vertices_reference(face))


CAMERA = camera_from_fov(0.5, 200, 160, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))


@pytest.fixture(scope="module")
def face_model() -> FaceModel:
    """Return the small head with lips: its triangles in front, 3 to 6 cm below the middle."""
    model = make_small_face_model()
    middle = model.template[model.faces].mean(1)
    regions = model.face_regions.clone()
    regions[(middle[:, 2] > 0.06) & (middle[:, 1] < -0.03) & (middle[:, 1] > -0.06)] = 2
    return replace(model, region_names=("skin", "eyes", "lips"), face_regions=regions)


def placed(face_model: FaceModel, yaw: float = 0.0, shift: tuple[float, float, float] = (0, 0, -0.6)) -> torch.Tensor:
    turn = matrix_from_axis_angle(torch.tensor([0.0, yaw, 0.0]))
    return face_model.template @ turn.T + torch.tensor(shift)


@pytest.mark.parametrize(("part", "region"), [("eyes", "eyes"), ("mouth", "lips")])
def test_boxes_enclose_the_regions_with_a_margin(face_model: FaceModel, part: str, region: str) -> None:
    vertices = placed(face_model)
    points, _ = CAMERA.project(vertices[face_model.faces[face_model.region_mask(region)].unique()])
    box = left, top, width, height = part_boxes(face_model, vertices, CAMERA)[part]
    seen_width = float(points[:, 0].max() - points[:, 0].min())
    assert 1.2 * seen_width < width < 1.5 * seen_width
    assert left < float(points[:, 0].min()) - 0.1 * seen_width
    assert top < float(points[:, 1].min()) - 0.1 * seen_width
    assert top + height > float(points[:, 1].max()) + 0.1 * seen_width
    # They grow with the picture.
    large = part_boxes(face_model, vertices, CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height))[part]
    assert all(abs(2 * a - b) <= 2 for a, b in zip(box, large, strict=True))


def test_parts_that_face_away_or_are_outside_are_missing(face_model: FaceModel) -> None:
    assert part_boxes(face_model, placed(face_model, yaw=0.8), CAMERA).keys() == {"eyes", "mouth"}
    for why, place in {
        "sideways": {"yaw": math.pi / 2}, "away": {"yaw": math.pi}, "behind the camera": {"shift": (0, 0, 0.6)},
        "beside the picture": {"shift": (0.3, 0, -0.6)}, "too far away": {"shift": (0, 0, -9)},
    }.items():  # fmt: skip
        assert part_boxes(face_model, placed(face_model, **place), CAMERA) == {}, why
    left, _, width, _ = part_boxes(face_model, placed(face_model, shift=(0.14, 0, -0.6)), CAMERA)["mouth"]
    assert left + width == CAMERA.width, "it is cut at the border"
    assert part_boxes(replace(face_model, region_names=("skin", "a", "b")), placed(face_model), CAMERA) == {}


def test_a_point_on_the_surface_is_found_again():
    model = make_small_face_model()
    random = torch.Generator().manual_seed(0)
    front = (model.template[model.faces].mean(1)[:, 2] > 0.05).nonzero()[:, 0]
    allowed = torch.zeros(len(model.faces), dtype=torch.bool)
    allowed[front] = True
    truth = front[torch.randint(len(front), (6,), generator=random)]
    weights = torch.tensor([6.0, 4.0, 2.0]) / 12
    points = (model.template[model.faces[truth]] * weights[:, None]).sum(1)
    pixels, depths, targets = [], [], []
    for _ in range(12):
        turn = matrix_from_axis_angle(0.4 * (2 * torch.rand(3, generator=random) - 1))
        pose = rigid_transform(torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ turn, torch.tensor([0.0, 0.0, 0.7]))
        camera = camera_from_fov(0.5, 512, 512, pose)
        projected, depth = camera.project(model.template)
        pixels.append(projected)
        depths.append(depth)
        targets.append(camera.project(points)[0])
    # One detection in twelve is far off.
    targets[5] = targets[5] + 200
    views = DetectedViews(torch.stack(pixels), torch.stack(depths), torch.stack(targets))
    for landmark in range(len(truth)):
        triangle, barycentric, error = best_point(views, model.faces, allowed, landmark)
        found = barycentric @ model.template[model.faces[triangle]]
        torch.testing.assert_close(found, points[landmark], atol=1e-6, rtol=0)
        assert error < 1e-2


assert len(IBUG68) == len(set(IBUG68)) == 68
assert (IBUG68[36], IBUG68[45]) == (33, 263), "the subject's right comes first: 33 is the outer corner of that eye"
PLACED = sorted({*LEFT_EYELIDS, *RIGHT_EYELIDS, *IBUG68[::4], *range(0, 478, 12)})
"""Landmarks that are placed. Each takes a search of its own, so some of them tell as much as all."""


@pytest.fixture(scope="module")
def few():
    model, place = load_face_model("anny"), embedding.best_point
    shipped = model.landmarks["mediapipe"]

    def place_some(views: DetectedViews, faces: Tensor, allowed: Tensor, landmark: int) -> tuple:
        if landmark in PLACED:
            return place(views, faces, allowed, landmark)
        return shipped.faces[landmark], shipped.barycentric[landmark], torch.tensor(0.0)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(embedding, "best_point", place_some)
        return model, *embed_landmarks(model, EmbeddingSettings(pictures=8, seed=3))


@pytest.mark.unchecked
def test_few_pictures_agree_with_the_shipped_landmarks(few, tmp_path, monkeypatch):
    model, landmarks, errors = few
    # 512 pixels show 0.34 m: 3 px are 2 mm.
    assert errors[PLACED].median() < 3.5
    points = landmarks["mediapipe"].positions(model.template, model.faces)
    distance = (model.landmark_positions(model.template, "mediapipe") - points).norm(dim=1)[PLACED]
    assert distance.median() < 0.0015
    assert distance.quantile(0.95) < 0.005
    # Landmarks of lids are not inside the eyeballs, which a picture cannot tell, since a hidden point looks as near.
    for name, lids in (("left_eye", LEFT_EYELIDS), ("right_eye", RIGHT_EYELIDS)):
        center = model.joint_template[model.joint_names.index(name)]
        ball = model.faces[model.region_mask("eyes", "irises")].unique()
        ball = ball[model.template[ball, 0] * center[0] > 0]
        radius = (model.template[ball] - center).norm(dim=1).median()
        assert ((points[list(lids)] - center).norm(dim=1) - radius).min() > -0.0015
    # What is written is read by the loader.
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "anny_landmarks.json"
    loading.write_landmarks(path, replace(model, landmarks=landmarks), "a command", 2.5)
    assert path.stat().st_size < 100_000
    assert json.loads(path.read_text())["topology_hash"] == model.topology_hash
    monkeypatch.setattr(loading.resources, "files", lambda package: tmp_path)
    read = loading.read_landmarks("anny", model)
    for name, marks in landmarks.items():
        assert torch.equal(read[name].faces, marks.faces)
        torch.testing.assert_close(read[name].barycentric, marks.barycentric, atol=1e-4, rtol=0)
