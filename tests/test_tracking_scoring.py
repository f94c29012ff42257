"""The neck line and the scoring mask decide which parts of a picture are scored."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.tracking import Tracking, draw_overlay, make_scoring, write_overlay
from mien.tracking.neck_line import bottom_vertices, fit_neck_lines
from mien.tracking.scoring import above_neck_line, cut_matte, head_crop
from small_face_model import make_small_face_model
from tracking_case import SIZE, capture_of, still_camera


def _upright(timesteps: int = 1, roll: float = 0.0):
    model = make_small_face_model()
    face = model.neutral(timesteps)
    translation, rotation = torch.tensor([0.0, 0.0, -0.9]), torch.tensor([0.0, 0.0, roll])
    return model, replace(
        face, head_translation=translation.expand(timesteps, 3), head_rotation=rotation.expand(timesteps, 3)
    )


def _tracking(model, face) -> Tracking:
    camera = still_camera().to(torch.zeros(()))
    return Tracking(
        "small", model.content_hash, face, torch.ones(len(face), dtype=torch.bool), (camera,),
        fit_neck_lines(model, face, (camera,)), torch.zeros(len(face), 1),
    )  # fmt: skip


def test_bottom_is_the_lowest_open_rim():
    model = make_small_face_model()
    bottom = bottom_vertices(model)
    assert len(bottom) == 28
    heights = model.template[bottom, 1]
    assert (heights < model.template[:, 1].min() + 1e-4).all()


def test_a_closed_model_has_no_neck():
    model = make_small_face_model()

    def twice(indices):
        return torch.cat([indices, indices])

    closed = replace(
        model, faces=twice(model.faces), uv_faces=twice(model.uv_faces), face_regions=twice(model.face_regions)
    )
    with pytest.raises(AssertionError, match="closed"):
        bottom_vertices(closed)


def test_neck_line_of_an_upright_head():
    """The neck line of an upright head is horizontal, at its bottom vertices."""
    model, face = _upright()
    camera = still_camera().to(torch.zeros(()))
    a, b, d = fit_neck_lines(model, face, (camera,))[0, 0].tolist()
    assert (a, b) == pytest.approx((0, -1), abs=1e-3)
    assert d == pytest.approx(float(camera.project(model(face)[0, bottom_vertices(model)])[0][:, 1].mean()), abs=1)
    x, y = camera.project(face.head_translation)[0][0].tolist()
    assert a * x + b * y + d > 50, "the head is above its neck"


def test_neck_line_turns_with_the_head():
    for roll in (-0.4, 0.3, 1.7):
        model, face = _upright(roll=roll)
        line = fit_neck_lines(model, face, (still_camera().to(torch.zeros(())),))[0, 0]
        # World y up is picture y down: up leans to the left for a positive roll.
        expected = torch.tensor([-np.sin(roll), -np.cos(roll)], dtype=torch.float32)
        torch.testing.assert_close(line[:2], expected, atol=2e-2, rtol=0)


def test_far_beside_the_neck_goes():
    camera = still_camera()
    neck = np.array([[200.0, 400.0], [300.0, 400.0]], np.float32)
    keep = above_neck_line(np.array([0.0, -1.0, 400.0], np.float32), neck, camera)
    assert keep[380, 250] == 1
    assert keep[420, 250] == 0
    assert keep[395, 120] == 0, "a shoulder that rises above the line"
    assert keep[200, 120] == 1, "hair beside the cheek"
    assert 0.4 < keep[399, 250] < 1.0 or keep[399, 250] == 1.0


def test_bowed_chin_stays_and_slivers_go():
    matte = np.full((100, 100), 255, np.uint8)
    keep = np.zeros((100, 100), np.float32)
    keep[:50] = 1
    keep[:, 40:] = np.where(keep[:, 40:] > 0, 1, 0)
    head = np.zeros((100, 100), bool)
    head[20:60, 50:70] = True
    matte[:, 30:40] = 0
    mask = cut_matte(matte, head, keep)
    assert mask[55, 60] == 255, "the chin below the line"
    assert mask[55, 80] == 0
    assert mask[30, 80] == 255
    assert mask[30, 10] == 0, "a part that the matte does not join to the head"


def test_matte_opacity_is_kept():
    matte = np.full((40, 40), 90, np.uint8)
    head = np.zeros((40, 40), bool)
    head[10:20, 10:20] = True
    mask = cut_matte(matte, head, np.ones((40, 40), np.float32))
    assert (mask == 90).all()


def test_head_crop_is_the_masks_box():
    mask = np.zeros((50, 60), np.uint8)
    mask[10:30, 20:25] = 255
    mask[0, 0] = 3
    assert head_crop(mask).tolist() == [20, 10, 5, 20]
    assert head_crop(np.zeros((50, 60), np.uint8)).tolist() == [0, 0, 60, 50]


def test_make_scoring():
    model, face = _upright(2)
    tracking = _tracking(model, face)
    capture = capture_of(torch.full((2, 478, 2), 100.0))
    scoring = make_scoring(capture, tracking, model)
    assert scoring.masks.shape == (2, 1, SIZE, SIZE)
    row = int(tracking.neck_lines[0, 0, 2])
    assert scoring.masks[0, 0, row - 10, SIZE // 2] == 255
    assert scoring.masks[0, 0, row + 20, SIZE // 2] == 0
    left, top, width, height = scoring.crops[0, 0]
    assert (left, top) == (0, 0)
    assert width == SIZE
    assert abs(top + height - row) < 15


def test_overlay(tmp_path):
    """The overlay shows mesh and landmarks, and is written as a video."""
    model, face = _upright(3)
    tracking = _tracking(model, face)
    tracking = replace(tracking, residuals=torch.tensor([[0.5], [torch.nan], [0.5]]))
    capture = capture_of(torch.full((3, 478, 2), 100.0), missing=(1,))
    picture = draw_overlay(capture, tracking, model, 0)
    assert picture.shape == (SIZE, 2 * SIZE, 3)
    assert (picture[256, SIZE + 256] != 128).any(), "the mesh is drawn"
    assert (picture[100, 100] == (60, 255, 60)).all(), "detected landmarks are green"
    write_overlay(tmp_path / "overlay.mp4", capture, tracking, model)
    assert (tmp_path / "overlay.mp4").stat().st_size > 1000
