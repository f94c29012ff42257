"""`mien bench quality` measures no error if the tracking is the truth, and the right amount if it is not."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch

from mien.capture import Capture
from mien.cli import main
from mien.commands.bench import CaptureName
from mien.lab.benchmarking.following import Following
from mien.lab.benchmarking.quality import (
    QualityRow,
    TrackingErrors,
    aligned_distance,
    crop_landmarks,
    markdown_table,
    tracking_cells,
    tracking_errors,
    visible_vertices,
)
from mien.lab.synthetic import RECIPES, REFERENCES, Segment, SyntheticScene, truth_of
from mien.render.mesh import vertex_normals

pytestmark = pytest.mark.unchecked
RECIPE = replace(
    RECIPES["demo"], width=128, height=128, fps=10.0, glasses=False, hair="none",
    texture_size=512, script=(Segment("free", 1.0), Segment("still", 1.5)),
)  # fmt: skip


@pytest.fixture(scope="module")
def case():
    scene = SyntheticScene(RECIPE, 3)
    truth, t = truth_of(scene), RECIPE.timesteps
    capture = Capture(
        name="case", camera_ids=("front",), fps=10.0, timestamps=np.arange(t) / 10,
        images=np.zeros((t, 1, 128, 128, 3), np.uint8), mattes=np.zeros((t, 1, 128, 128), np.uint8),
        landmarks=truth.landmarks, valid=np.ones((t, 1), bool), principal_point=np.full((1, 2), 64.0, np.float32),
        source={},
    )  # fmt: skip
    return scene, capture, truth


def test_the_truth_has_no_error(case):
    scene, capture, truth = case
    errors = tracking_errors(truth.tracking, capture, truth, scene.model)
    assert errors.vertex_mm < 0.02
    assert errors.landmark_px < 0.05
    assert errors.rotation_deg < 0.05
    for figure, most in ((errors.jitter_px, 0.01), (errors.jitter_mm, 0.01), (errors.iris_deviation_percent, 0.7)):
        assert figure is not None
        assert figure < most
    assert errors.turns is None or abs(errors.turns.loss_percent) < 0.1


def test_a_constant_turn_is_not_unsteady(case):
    scene, capture, truth = case
    face = truth.tracking.face
    still, turned = (
        replace(truth.tracking, face=replace(face, head_rotation=0 * face.head_rotation + torch.tensor([0, yaw, 0])))
        for yaw in (0.0, 0.1)
    )
    errors = tracking_errors(turned, capture, replace(truth, tracking=still), scene.model)
    assert errors.rotation_deg == pytest.approx(np.degrees(0.1), abs=1e-2)
    assert errors.rotation_steady_deg < 0.05


def test_another_expression_is_a_distance_and_noise_is_jitter(case):
    scene, capture, truth = case
    face, random = truth.tracking.face, torch.Generator().manual_seed(0)
    open_mouth = face.expression.clone()
    open_mouth[:, scene.model.expression_names.index("jawOpen")] += 0.5
    shift = 0.002 * torch.randn(len(face), 3, generator=random)
    worse = replace(face, expression=open_mouth, head_translation=face.head_translation + shift)
    errors = tracking_errors(replace(truth.tracking, face=worse), capture, truth, scene.model)
    assert 1 < errors.vertex_mm < 10
    assert (errors.jitter_px or 0) > 0.3
    assert 2 < (errors.jitter_mm or 0) < 20


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
    cosine, visible = cosine.numpy()[truth.vertex_index], visible_vertices(turned, scene.model, 0)
    # Normals at the region's rim differ, since the benchmark takes the region's triangles only.
    assert visible[cosine > 0.22].mean() > 0.98
    assert visible[cosine < 0.18].mean() < 0.03


def test_distances_do_not_see_rotation_scale_and_shift():
    random = np.random.default_rng(0)
    points = random.normal(size=(50, 3))
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    assert aligned_distance(3 * points @ turn.T + 5, points) < 1e-9
    assert aligned_distance(points @ turn.T + 5, points, rigid=True) < 1e-9
    assert aligned_distance(3 * points @ turn.T + 5, points, rigid=True) > 1  # a wrong scale counts there
    assert aligned_distance(points * [1, 1, -1], points) > 0.1  # but they do see a mirror


def test_truth_follows_the_capture_s_crop(case):
    _, capture, truth = case
    cropped = replace(capture, source={"crop": {"left": 32, "top": 16, "width": 64, "height": 32}})
    moved = crop_landmarks(truth.landmarks, cropped)
    np.testing.assert_allclose(moved, (truth.landmarks - [32, 16]) * [2, 4], rtol=1e-5)


def test_the_table_names_key_and_baselines(tmp_path, capsys):
    figures = {"psnr": 30.0, "ssim": 0.9, "l1": 0.01, "perceptual": None}
    figures = {**figures, "head": dict(figures)}
    protocols = {"novel_view": {**figures, "baselines": {"mean_frame": figures, "mesh": figures}}}
    errors = {"a": TrackingErrors(1.0, 2.0, 3.0, 0.5, None)}
    table = markdown_table([QualityRow("ring-16", "abcd", "a_method", 10, 99, protocols, errors, {"draw": 1.0})])
    assert "ring-16 (`abcd`) | novel_view | avatar | 30.00 / 0.900 / 0.0100 / - |" in table
    assert "mean frame" in table
    assert "| mesh |" in table
    assert "1.00 mm | 2.00 px | 3.00 (0.50) deg | - | - | - | - |" in table
    known = TrackingErrors(1.0, 2.0, 3.0, 0.5, 0.02, 0.04, Following(0.3, 7.0, 5), None, 0.61)
    assert tracking_cells(known).endswith("| 0.020 px, 0.040 mm | 0.30 frames, 7 % (5) | - | 0.61 %")
    # An unknown capture is told.
    assert main(["bench", "quality", "--captures", "mono", "--out", str(tmp_path)]) == 2
    assert "mono-short" in capsys.readouterr().err
    assert set(get_args(CaptureName)) == set(REFERENCES), "the command line knows their names without importing them"
