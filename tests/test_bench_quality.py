"""`mien bench quality` measures no error if the tracking is the truth, and the right amount if it is not.
Known lags, losses of amplitude and jitter are found."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from capture_helpers import random_capture
from mien.commands.bench import CaptureName
from mien.lab.benchmarking import following, quality
from mien.lab.synthetic import RECIPES, REFERENCES, Segment, SyntheticScene, Truth, truth_of
from mien.render.mesh import vertex_normals
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.tracking import Tracking
from refusals import complaint
from small_face_model import make_small_face_model
from tracking_case import still_camera

pytestmark = pytest.mark.unchecked
RECIPE = replace(
    RECIPES["demo"], width=128, height=128, fps=10.0, glasses=False, hair="none",
    texture_size=512, script=(Segment("free", 1.0), Segment("still", 1.5)),
)  # fmt: skip


@pytest.fixture(scope="module")
def case():
    scene = SyntheticScene(RECIPE, 3)
    truth, t = truth_of(scene), RECIPE.timesteps
    images, mattes = np.zeros((t, 1, 128, 128, 3), np.uint8), np.zeros((t, 1, 128, 128), np.uint8)
    capture = replace(
        random_capture(t, 1), images=images, mattes=mattes, landmarks=truth.landmarks, source={}, fps=10.0
    )
    return scene, replace(capture, valid=np.ones((t, 1), bool)), truth


def test_the_truth_has_no_error(case):
    scene, capture, truth = case
    errors = quality.tracking_errors(truth.tracking, capture, truth, scene.model)
    for name, most in {
        "vertex_mm": 0.02, "landmark_px": 0.05, "rotation_deg": 0.05, "jitter_px": 0.01, "jitter_mm": 0.01,
        "iris_deviation_percent": 0.7,
    }.items():  # fmt: skip
        assert getattr(errors, name) < most, name
    assert errors.turns is None or abs(errors.turns.loss_percent) < 0.1
    # A constant turn is not unsteady.
    face = truth.tracking.face
    still, turned = (
        replace(truth.tracking, face=replace(face, head_rotation=0 * face.head_rotation + torch.tensor([0, yaw, 0])))
        for yaw in (0.0, 0.1)
    )
    errors = quality.tracking_errors(turned, capture, replace(truth, tracking=still), scene.model)
    assert errors.rotation_deg == pytest.approx(np.degrees(0.1), abs=1e-2)
    assert errors.rotation_steady_deg < 0.05
    # Another expression is a distance, and noise is jitter.
    face, random = truth.tracking.face, torch.Generator().manual_seed(0)
    open_mouth = face.expression.clone()
    open_mouth[:, scene.model.expression_names.index("jawOpen")] += 0.5
    shift = 0.002 * torch.randn(len(face), 3, generator=random)
    worse = replace(face, expression=open_mouth, head_translation=face.head_translation + shift)
    errors = quality.tracking_errors(replace(truth.tracking, face=worse), capture, truth, scene.model)
    assert 1 < errors.vertex_mm < 10
    assert (errors.jitter_px or 0) > 0.3
    assert 2 < (errors.jitter_mm or 0) < 20
    # The truth follows the capture's crop.
    cropped = replace(capture, source={"crop": {"left": 32, "top": 16, "width": 64, "height": 32}})
    moved = quality.crop_landmarks(truth.landmarks, cropped)
    np.testing.assert_allclose(moved, (truth.landmarks - [32, 16]) * [2, 4], rtol=1e-5)


@pytest.mark.parametrize("yaw", [0.0, 1.2, -1.2])
def test_vertices_that_do_not_face_the_camera_are_left_out(case, yaw):
    """A vertex counts if the cosine of its normal and the direction to a camera is above 0.2."""
    scene, _, truth = case
    rotation = torch.tensor([0.0, yaw, 0.0]).expand_as(truth.tracking.face.head_rotation)
    face = replace(truth.tracking.face, head_rotation=rotation)
    turned = replace(truth, tracking=replace(truth.tracking, face=face))
    vertices = scene.model(face[0])
    towards = truth.tracking.cameras[0].position - vertices[0]
    cosine = (vertex_normals(vertices, scene.model.faces)[0] * towards).sum(-1) / towards.norm(dim=-1)
    cosine, visible = cosine.numpy()[truth.vertex_index], quality.visible_vertices(turned, scene.model, 0)
    # Normals at the region's rim differ, since the benchmark takes the region's triangles only.
    assert visible[cosine > 0.22].mean() > 0.98
    assert visible[cosine < 0.18].mean() < 0.03


def test_distances_do_not_see_rotation_scale_and_shift():
    random = np.random.default_rng(0)
    points = random.normal(size=(50, 3))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert quality.aligned_distance(3 * points @ turn.T + 5, points) < 1e-9
    assert quality.aligned_distance(points @ turn.T + 5, points, rigid=True) < 1e-9
    assert quality.aligned_distance(3 * points @ turn.T + 5, points, rigid=True) > 1  # a wrong scale counts there
    assert quality.aligned_distance(points * [1, 1, -1], points) > 0.1  # but they do see a mirror


def test_the_table_names_key_and_baselines(tmp_path, capsys):
    figures = {"psnr": 30.0, "ssim": 0.9, "l1": 0.01, "perceptual": None}
    figures = {**figures, "head": dict(figures)}
    protocols = {"novel_view": {**figures, "baselines": {"mean_frame": figures, "mesh": figures}}}
    errors = {"a": quality.TrackingErrors(1.0, 2.0, 3.0, 0.5, None)}
    table = quality.markdown_table(
        [quality.QualityRow("ring-16", "abcd", "a_method", 10, 99, protocols, errors, {"draw": 1.0})]
    )
    assert "ring-16 (`abcd`) | novel_view | avatar | 30.00 / 0.900 / 0.0100 / - |" in table
    assert "mean frame" in table
    assert "| mesh |" in table
    assert "1.00 mm | 2.00 px | 3.00 (0.50) deg | - | - | - | - |" in table
    known = quality.TrackingErrors(1.0, 2.0, 3.0, 0.5, 0.02, 0.04, following.Following(0.3, 7.0, 5), None, 0.61)
    assert quality.tracking_cells(known).endswith("| 0.020 px, 0.040 mm | 0.30 frames, 7 % (5) | - | 0.61 %")
    # An unknown capture is told.
    assert "mono-short" in complaint(capsys, "bench", "quality", "--captures", "mono", "--out", str(tmp_path))
    assert set(get_args(CaptureName)) == set(REFERENCES), "the command line knows their names without importing them"


FPS = 25.0
TIME = np.arange(100.0)


def bumps(delay: float = 0.0, height: float = 1.0, width: float = 2.0) -> np.ndarray:
    """Return the coefficient of two blinks over time."""
    return height * np.stack([np.exp(-(((TIME - at - delay) / width) ** 2)) for at in (30.0, 62.0)]).sum(0)


def found_in(values: np.ndarray) -> following.Following:
    found = following.following(values[:, None], bumps()[:, None], bumps() > 0.3, 6)
    assert found is not None
    return found


def test_delay_and_height_are_found_in_coefficients_and_in_turns():
    for delay, height in [(-1.3, 0.8), (0.0, 1.0), (0.6, 1.1), (2.0, 0.8)]:
        found = found_in(5 + bumps(delay, height))
        assert found.lag_frames == pytest.approx(delay, abs=0.1)
        assert found.loss_percent == pytest.approx(100 * (1 - height), abs=2)
        assert found.events == 2
    # Where nothing happens there is nothing to measure, and an event that was not tracked is left out.
    assert following.following(bumps()[:, None], bumps()[:, None], np.zeros(len(TIME), bool), 6) is None
    gap = bumps()
    gap[28:33] = np.nan
    assert found_in(gap).events == 1
    _, truth = exact_of(turns())
    off = matrix_from_axis_angle(torch.tensor([0.05, 0.1, -0.08]))
    late = axis_angle_from_matrix(matrix_from_axis_angle(turns(1.5, 0.9)) @ off.T)
    found = following.turn_following(exact_of(late)[0], truth, FPS)
    assert found is not None
    assert found.lag_frames == pytest.approx(1.5, abs=0.1)
    assert found.loss_percent == pytest.approx(10, abs=2)
    assert following.turn_following(exact_of(turns())[0], exact_of(0 * turns())[1], FPS) is None
    # A mean rotation is in the middle.
    vectors = torch.tensor([[0.0, 0.3, 0.0], [0.0, -0.1, 0.0]])
    middle = axis_angle_from_matrix(following.mean_rotation(matrix_from_axis_angle(vectors)))
    torch.testing.assert_close(middle, torch.tensor([0.0, 0.1, 0.0]).double(), atol=1e-6, rtol=0)


def exact_of(rotations: torch.Tensor) -> tuple[Tracking, Truth]:
    face = replace(make_small_face_model().neutral(len(rotations)), head_rotation=rotations)
    tracking = Tracking(
        face_model="small", face_model_hash="", face=face, valid=torch.ones(len(rotations)).bool(),
        cameras=(still_camera().to(torch.zeros(())),), neck_lines=torch.zeros(len(rotations), 1, 3),
        residuals=torch.zeros(len(rotations), 1),
    )  # fmt: skip
    nothing = np.zeros((len(rotations), 1, 478, 2), np.float32)
    return tracking, Truth(tracking, np.zeros(1, np.int64), np.zeros((len(rotations), 1, 3), np.float32), nothing)


def turns(delay: float = 0.0, share: float = 1.0) -> torch.Tensor:
    """Return pitch and yaw that turn and come back, at 60 degrees a second at most."""
    angle = share * np.stack([0.1 * bumps(delay, width=5.0), 0.4 * bumps(delay, width=5.0), 0 * TIME], axis=1)
    return torch.from_numpy(angle).float()


def test_blinks_are_seen_in_the_lids():
    open_eyes = np.random.default_rng(0).uniform(100, 200, (1, 1, 478, 2)).repeat(len(TIME), 0)
    _, truth = exact_of(0 * turns())

    def blinking(delay: float, depth: float) -> np.ndarray:
        points = open_eyes.copy()
        for upper, lower in following.LIDS:
            share = depth * bumps(delay)[:, None, None]
            points[:, :, upper] += share * (points[:, :, lower] - points[:, :, upper])
        return points

    true, tracked = blinking(0.0, 0.9), blinking(1.0, 0.6)
    assert following.eye_opening(true[:, 0]).min() < 0.2 * following.eye_opening(true[:, 0]).max()
    found = following.blink_following(tracked, true, truth, FPS)
    assert found is not None
    assert found.events == 2
    assert found.lag_frames == pytest.approx(1.0, abs=0.1)
    assert found.loss_percent == pytest.approx(100 * (1 - 0.6 / 0.9), abs=3)
    assert following.blink_following(tracked, open_eyes, truth, FPS) is None
    # Jitter counts where the truth stands still.
    true = np.zeros((20, 1, 478, 2), np.float32)
    true[10:] += np.arange(10)[:, None, None, None]
    still = following.still_timesteps(true)
    assert (still[:8].all(), still[9:].any()) == (True, False)
    points = np.zeros((20, 478, 3))
    points[1::2, :, 0] = 0.001
    points[12:] = 50 * np.random.default_rng(0).standard_normal((8, 478, 3))
    assert following.jitter(points, still) == pytest.approx(0.002)
    assert following.jitter(points, np.zeros(18, bool)) is None
