"""The bust: anny's head on a torso that has a pose of its own, and a build that moves no head."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.camera import Camera
from mien.driving.transfer import place_torso
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.torso import TorsoPose, build_directions, still_torso, torso_pose, with_torso
from mien.lab.benchmarking import torso
from mien.lab.benchmarking.quality import torso_cells
from mien.lab.benchmarking.torso import outline_motion
from mien.render.mesh import rasterize_mesh
from mien.rotation import matrix_from_axis_angle
from mien.runtime.posing import rig_points
from mien.tracking.landmarks.clothes import Clothes
from mien.tracking.landmarks.torso import SHOULDERS, fit_torso
from mien.tracking.neck_line import bottom_vertices
from mien.tracking.scoring import make_scoring
from mien.tracking.settings import ScoringSettings, TrackingSettings
from mien.tracking.tracking import Tracking
from mien.training.footage.coverage import Coverage
from mien.training.whole_head.soft_cut import with_soft_cut
from mien.training.whole_head.unseen import END, fading_end
from plain_settings import plain_gaussian_avatars
from toy_scene import toy_camera
from tracking_case import capture_of
from web_case import pose_by_node

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


def test_the_motion_of_shoulders_under_a_turning_head_is_measured(bust, monkeypatch):
    rest = bust.neutral(1)
    rest.head_translation[:, 2] = -1.0
    avatar = GaussianAvatars(plain_gaussian_avatars(), bust, rest)
    with torch.no_grad():
        avatar.store["opacity_logits"].fill_(4.0)
        avatar.store["log_scales"].copy_(torch.tensor([-1.1, -4.0, -1.1]))
    still = outline_motion(avatar, rest, CAMERA)
    assert still is not None
    assert still < 0.3
    monkeypatch.setattr(torso, "still_torso", lambda model, face, like: place_torso(model, face, like, "head"))
    assert (outline_motion(avatar, rest, CAMERA) or 0) > 1.5
    close = replace(rest, head_translation=rest.head_translation * torch.tensor([0.0, 0.0, 0.3]))
    assert outline_motion(avatar, close, CAMERA) is None
    errors = torso.TorsoErrors((0.4, 1.6, 0.3), (0.1, 0.2, 0.3), 0.7)
    assert torso_cells(errors, still)[:3] == ["0.4, 1.6, 0.3 deg", "0.1, 0.2, 0.3 deg", "0.7 %"]


def test_driven_heads_move_on_a_torso_that_stands_follows_or_moves_along(bust):
    person = turned(bust)[0]
    away = torch.tensor([[0.0, 0, 0], [0.015, 0, 0], [0.3, 0, 0]])
    heads = replace(
        person[[0, 0, 0]], head_translation=person.head_translation + away,
        head_rotation=torch.tensor([[0.0, 0, 0], [0.0, 0.35, 0], [0.0, 0, 0]]),
    )  # fmt: skip
    rest = torso_pose(bust, person)
    still = torso_pose(bust, place_torso(bust, heads, person))
    torch.testing.assert_close(still.rotation, rest.rotation.expand(3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(still.translation[:2], rest.translation.expand(2, 3), atol=1e-5, rtol=0)
    # A head that moves away takes the torso with it, so that no neck is stretched by more than 5 cm.
    assert 0.25 < float(still.translation[2, 0] - rest.translation[0, 0]) < 0.3
    with_head = torso_pose(bust, place_torso(bust, heads, person, "head"))
    torch.testing.assert_close(with_head.rotation, heads.head_rotation, atol=1e-5, rtol=0)
    driver = still_torso(bust, heads, heads[0], free=1.0)
    moved = torso_pose(bust, driver)
    driver = with_torso(bust, driver, TorsoPose(moved.rotation + 0.1, moved.translation + 0.01))
    followed = torso_pose(bust, place_torso(bust, heads, person, "driver", (driver, heads[0])))
    torch.testing.assert_close(followed.translation, rest.translation.expand(3, 3) + 0.01, atol=1e-4, rtol=0)
    assert float(followed.rotation[0, 1]) == pytest.approx(0.1, abs=1e-3)


def test_python_without_torch_and_pages_let_the_same_torso_stand_still(bust, built, tmp_path):
    avatar = GaussianAvatars(plain_gaussian_avatars(), bust, turned(bust)[0])
    portable = make_portable(avatar, toy_camera(64), "bust")
    assert isinstance(portable.baked, runtime.MeshBound)
    assert with_soft_cut(portable, avatar) is portable, "a bust has no end at the neck"
    face = turned(bust)
    by_torch = place_torso(bust, face, avatar.subject)
    alone = runtime.Avatar(portable)
    found, given = [], []
    for step in range(1, len(face)):
        rotation, place = face.head_rotation[step].numpy(), face.head_translation[step].numpy()
        posed = alone.face(face.expression[step].numpy(), None, rotation, place)
        np.testing.assert_allclose(posed.joints[[0, 3]], by_torch.joints[step, [0, 3]].numpy(), atol=1e-5)
        np.testing.assert_allclose(posed.expression[-3:], by_torch.expression[step, -3:].numpy(), atol=1e-5)
        found.append(posed)
        given.append(replace(posed, joints=0 * posed.joints, expression=face.expression[step].numpy()))
    path = stored_as(tmp_path / "bust.mien", portable)
    sizes = [portable.baked.rig.template.size, portable.baked.means.size, len(portable.baked.means)]
    for by_node, posed in zip(pose_by_node(built, path, given, [*sizes, -1][:3]), found, strict=True):
        np.testing.assert_allclose(by_node[0], rig_points(portable.baked.rig, posed).reshape(-1), atol=2e-5)


def stored_as(path: Path, portable: runtime.PortableAvatar) -> Path:
    runtime.write_portable(path, portable)
    return path


def test_what_is_scored_without_a_cut_is_the_whole_person_and_head_crops_stay(bust):
    face = bust.neutral(1)
    face.head_translation[:, 2] = -1.2
    drawn = rasterize_mesh(bust(face)[0], bust.faces, CAMERA).face_index.numpy() >= 0
    matte = np.where(drawn, 255, 0).astype(np.uint8)
    matte[:20, :20] = 255  # what is beside the person
    capture = capture_of(torch.zeros(1, 478, 2))
    capture = replace(capture, mattes=matte[None, None])
    tracking = Tracking(
        bust.name, bust.content_hash, face, torch.ones(1, dtype=torch.bool), (CAMERA,),
        torch.zeros(1, 1, 3), torch.zeros(1, 1),
    )  # fmt: skip
    plane, whole = (make_scoring(capture, tracking, bust, cut=cut) for cut in ("plane", "none"))
    np.testing.assert_array_equal(whole.masks[0, 0] > 0, drawn)
    assert (plane.masks[0, 0] > 0).sum() < 0.6 * drawn.sum()
    np.testing.assert_array_equal(whole.crops, plane.crops)
    settings = TrackingSettings()
    assert [ScoringSettings().cut_after(settings, torso=torso) for torso in (True, False)] == ["none", "plane"]
    assert ScoringSettings("plane").cut_after(settings, torso=True) == "plane"


def test_the_end_of_a_bust_fades_below_what_is_filmed(bust):
    vertices, is_bust = bust.template, bust.region_mask("bust")
    heights = vertices[bust.faces, 1]
    for lowest in (-0.3, -9.0):
        shown = (heights.mean(1) > lowest).float()
        opacities = fading_end(bust, vertices, is_bust, Coverage(shown, torch.zeros(len(shown), 3), shown))
        end = max(lowest - END, float(heights.amin()))
        assert (opacities[~is_bust] == 1).all()
        assert (opacities[is_bust & (heights.mean(1) < end - 0.03)] < 1e-6).all()
        assert (opacities[is_bust & (heights.amin(1) > end + END + 0.03)] == 1).all()
        between = opacities[is_bust & (opacities > 0) & (opacities < 1)]
        assert len(between) > 20
