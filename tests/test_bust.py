"""The bust: anny's head on a torso that has a pose of its own, and a build that moves no head."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien.camera import Camera
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.torso import TorsoPose, build_directions, still_torso, torso_pose, with_torso
from mien.rotation import matrix_from_axis_angle
from mien.tracking.landmarks.clothes import Clothes
from mien.tracking.landmarks.torso import SHOULDERS, fit_torso
from mien.tracking.neck_line import bottom_vertices

head_only = pytest.fixture(scope="module")(lambda: load_face_model("anny"))
bust = pytest.fixture(scope="module")(lambda: load_face_model("anny-bust"))
CAMERA = Camera(
    torch.tensor([[700.0, 0, 256], [0, 700, 256], [0, 0, 1]]), torch.diag(torch.tensor([1.0, -1, -1, 1])), 512, 512
)
POSES = torch.tensor([[0.0, 0.35, 0.0], [0.35, 0.0, 0.0], [0.0, 0.0, -0.35], [0.3, -0.9, 0.2]])


def turned(model: FaceModel, seed: int = 0) -> FaceParams:
    """Return a person at rest, then with the head turned by `POSES` and moved, with gaze and expressions."""
    random = torch.Generator().manual_seed(seed)
    face = model.neutral(1 + len(POSES))
    face.identity.copy_(0.7 * torch.randn(face.identity.shape, generator=random))
    face.head_rotation[1:], face.head_translation[1:] = POSES, 0.02 * torch.randn(len(POSES), 3, generator=random)
    face.expression[1:] = 0.2 * torch.rand(face.expression[1:].shape, generator=random)
    return face


def of_bust(model: FaceModel) -> Tensor:
    """Return the vertices that move with the torso alone."""
    return (model.skinning_weights[:, model.joint_names.index("torso")] == 1).nonzero()[:, 0]


def in_head(model: FaceModel) -> Tensor:
    """Return the vertices that the torso does not move."""
    neck, torso = (model.skinning_weights[:, model.joint_names.index(name)] for name in ("neck", "torso"))
    return ((neck == 0) & (torso == 0)).nonzero()[:, 0]


def test_its_head_is_that_of_the_head_only_model_to_the_bit(head_only, bust):
    h, f = len(head_only.template), len(head_only.faces)
    same = in_head(bust)
    assert len(same) > 0.9 * h
    assert same.max() < h
    assert torch.equal(bust.faces[:f], head_only.faces)
    assert torch.equal(bust.face_regions[:f], head_only.face_regions)
    assert bust.region_names[: len(head_only.region_names)] == head_only.region_names
    assert torch.equal(bust.template[same], head_only.template[same])
    assert torch.equal(bust.identity_basis[: len(head_only.identity_basis), same], head_only.identity_basis[:, same])
    assert torch.equal(bust.expression_basis[:-3, :h], head_only.expression_basis)
    assert bust.landmarks.keys() >= {"mediapipe", "ibug68"}
    for name in ("mediapipe", "ibug68"):
        places = (one.landmark_positions(one.template, name) for one in (bust, head_only))
        assert torch.equal(*places)
    # The same coefficients pose the same head.
    face = turned(bust)
    count, shapes = len(head_only.identity_basis), len(head_only.expression_names)
    motion = {"expression": face.expression[:, :shapes], "joints": face.joints[:, :-1]}
    theirs = replace(face, identity=face.identity[:count], **motion)
    torch.testing.assert_close(bust(face)[:, same], head_only(theirs)[:, same], atol=2e-6, rtol=0)


def test_the_mesh_is_closed_from_the_head_to_the_chest_and_faces_outwards(bust):
    mask = bust.region_mask("bust")
    below = bust.faces[mask].unique()
    points = bust.template[below]
    assert 0.36 < points[:, 0].max() - points[:, 0].min() < 0.56
    assert -0.55 < points[:, 1].min() < -0.45
    template = bust.template.double()
    assert torch.cdist(template * torch.tensor([-1.0, 1.0, 1.0]), template).min(1).values.max() < 1e-5
    edges = torch.cat([bust.faces[:, [0, 1]], bust.faces[:, [1, 2]], bust.faces[:, [2, 0]]])
    unique, counts = edges.sort(1).values.unique(dim=0, return_counts=True)
    assert counts.max() == 2
    open_below = unique[counts == 1]
    open_below = open_below[torch.isin(open_below, below).all(1)].unique()
    assert bust.template[open_below, 1].max() < -0.33, "only chest and arms are open"
    a, b, c = bust.template[bust.faces[mask]].unbind(1)
    outward = torch.linalg.cross(b - a, c - a)
    chest = (a[:, 0].abs() < 0.08) & (a[:, 1] > -0.35)
    assert (outward[chest & (a[:, 2] > 0.0), 2] > 0).all()
    assert (outward[chest & (a[:, 2] < -0.08), 2] < 0).all()
    a, b, c = bust.uv[bust.uv_faces].unbind(1)
    areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (areas > 0).float().mean() > 0.995
    assert 0 <= bust.uv.min() < bust.uv.max() <= 1
    assert (bust.skinning_weights >= 0).all()
    torch.testing.assert_close(bust.skinning_weights.sum(1), torch.ones(len(bust.template)), atol=1e-5, rtol=0)


def test_the_torso_stands_still_while_the_head_moves_and_moves_with_it_by_default(bust):
    face = turned(bust)
    ours, theirs = of_bust(bust), in_head(bust)
    below = bust.faces[bust.region_mask("bust")].unique()
    assert torch.isin(below, ours).float().mean() > 0.9
    assert bust.skinning_weights[below, bust.joint_names.index("torso")].min() > 0.5
    on_still = still_torso(bust, face, face[0], free=1.0)
    still = bust(on_still)
    torch.testing.assert_close(still[:, ours], still[:1, ours].expand(len(face), -1, -1), atol=2e-6, rtol=0)
    moving = bust(face)
    torch.testing.assert_close(still[:, theirs], moving[:, theirs], atol=2e-6, rtol=0)
    assert (moving[1:, ours] - moving[:1, ours]).norm(dim=2).mean() > 0.02
    # A pose of its own moves it rigidly, whatever the head does.
    own = torso_pose(bust, on_still)
    rotation = own.rotation + 0.2 * torch.cat([POSES[:1], POSES])
    posed = with_torso(bust, face, TorsoPose(rotation, own.translation + 0.01))
    R, origin = matrix_from_axis_angle(rotation), own.translation[0]
    to_rest = matrix_from_axis_angle(own.rotation[0])
    expected = (still[0, ours] - origin) @ to_rest @ R.mT + origin + 0.01
    torch.testing.assert_close(bust(posed)[:, ours], expected, atol=4e-6, rtol=0)
    for found, given in zip(torso_pose(bust, posed), (rotation, own.translation + 0.01), strict=True):
        torch.testing.assert_close(found, given, atol=2e-6, rtol=0)


def test_the_neck_between_them_neither_tears_nor_shrinks(bust):
    face = replace(turned(bust), head_translation=torch.zeros(1 + len(POSES), 3))
    face = still_torso(bust, face, face[0], free=1.0)
    edges = torch.cat([bust.faces[:, [0, 1]], bust.faces[:, [1, 2]], bust.faces[:, [2, 0]]])
    bent = bust.skinning_weights[:, [0, bust.joint_names.index("torso")]].amax(1) < 1
    edges = edges[bent[edges].any(1)]
    lengths = torch.stack([(v[edges[:, 0]] - v[edges[:, 1]]).norm(dim=1) for v in bust(face)])
    # Nodding, turning and tilting by 20 degrees.
    stretch = lengths[1:4] / lengths[0]
    assert stretch.max() < 2.0
    assert stretch.min() > 0.5
    # Twisted by 60 degrees, the middle of the neck keeps its girth: half of the turn is the neck joint's.
    twisted = bust.neutral(2)
    twisted.head_rotation[1, 1] = torch.pi / 3
    posed = bust(still_torso(bust, twisted, twisted[0], free=1.0))
    middle = bust.skinning_weights[:, bust.joint_names.index("neck")] > 0.6
    axis = bust.joint_template[bust.joint_names.index("torso"), [0, 2]]
    first, then = ((one[middle][:, [0, 2]] - axis).norm(dim=1).mean() for one in posed)
    assert then / first > 0.97


def test_build_sets_shoulders_and_neck_and_moves_no_head(head_only, bust):
    build = bust.identity_basis[len(head_only.identity_basis) :]
    assert len(build) == 12
    assert not build[:, in_head(bust)].any()
    arm = bust.template[:, 0] > 0.12
    side = arm & (bust.template[:, 1] > -0.26)
    shoulder, top = (bust.template[:, 0] * side).argmax(), (bust.template[:, 1] - 9.0 * ~side).argmax()
    collar = bust.faces[bust.region_mask("bust")].unique()
    front = collar[(bust.template[collar, 0].abs() < 0.02) & (bust.template[collar, 2] > 0)]
    notch = front[bust.template[front, 1].argmax()]
    # Width at the shoulder, height of the shoulder above the notch between the collar bones, height of the notch.
    effects = torch.stack([build[:, shoulder, 0], build[:, top, 1] - build[:, notch, 1], build[:, notch, 1]], dim=1)
    wanted = torch.diag(torch.tensor([0.015, 0.01, 0.01]))
    coefficients = torch.linalg.lstsq(effects.T, wanted).solution
    torch.testing.assert_close(effects.T @ coefficients, wanted, atol=1e-4, rtol=0)
    assert coefficients.abs().max() < 3.0, "each can be set by itself, within what people have"


def test_the_base_of_the_neck_is_where_it_is_without_a_bust(head_only, bust):
    assert torch.equal(bottom_vertices(bust), bottom_vertices(head_only))


def test_a_torso_is_found_by_shoulders_and_clothes_without_those_that_are_wrong(bust):
    times = torch.arange(24) / 12
    face = bust.neutral(len(times))
    face.head_translation[:, 2] = -0.8
    face.head_rotation[:, 1] = 0.4 * torch.sin(2 * times)
    face.identity[build_directions(bust).start + 2] = 1.0
    # It sways sideways: one camera does not tell how far away it is.
    sway = 0.01 * torch.sin(times)[:, None] * torch.tensor([1.0, 0, 0])
    place = torso_pose(bust, face[0]).translation + sway
    turn = torch.stack([0 * times, 0.1 * torch.sin(times), 0.1 * torch.cos(times)], dim=1)
    vertices = bust(with_torso(bust, face, TorsoPose(turn, place)))
    shoulders = bust.landmark_positions(vertices, "shoulders").reshape(len(times), 2, 2, 3).mean(2)
    points = torch.full((len(times), 33, 4), torch.nan)
    points[:, SHOULDERS] = torch.cat([CAMERA.project(shoulders)[0], torch.ones(len(times), 2, 2)], dim=2)
    points[5] = torch.nan
    points[9, SHOULDERS[0], :2] += 80.0
    chest = of_bust(bust)[::20]
    chest = chest[bust.template[chest, 2] > 0.02]
    frame, point = (one.flatten() for one in torch.meshgrid(torch.arange(24), torch.arange(len(chest)), indexing="ij"))
    pixels = CAMERA.project(vertices[:, chest].reshape(-1, 3))[0]
    pixels[::9] += 60.0
    noise = 0.01 * torch.randn(len(chest), 3, generator=torch.Generator().manual_seed(0))
    guessed = bust.template[chest] - bust.joint_template[bust.joint_names.index("torso")] + noise
    start = replace(face, identity=torch.zeros_like(face.identity))
    width = (shoulders[0, 0] - shoulders[0, 1]).norm()
    errors = []
    for clothes in (None, Clothes(guessed, point, frame, pixels)):
        found = fit_torso(bust, start, CAMERA, points, times, clothes=clothes)
        pose = torso_pose(bust, found)
        assert (pose.translation - place).norm(dim=1).max() < 0.04 * width
        errors.append(torch.rad2deg(pose.rotation - turn))
        assert not found.identity[: build_directions(bust).start].any()
        assert found.identity[build_directions(bust)].norm() > 0.1
    assert errors[0].norm(dim=1).median() < 6.0
    # The points tell how it turns: the error that all frames share is left.
    assert (errors[1] - errors[1].mean(0)).norm(dim=1).max() < 1.5
    assert errors[1][:, 2].abs().max() < 1.5
