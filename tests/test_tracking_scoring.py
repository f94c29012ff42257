"""The neck line and the scoring mask decide which parts of a picture are scored."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.camera import Camera, look_at
from mien.tracking import ScoringSettings, Tracking, make_scoring, write_overlay
from mien.tracking.neck_cut import NeckParts, above_neck_cut, fit_neck_cut
from mien.tracking.neck_line import bottom_vertices, fit_neck_lines
from mien.tracking.report.overlay import OverlayPainter
from mien.tracking.scoring import cut_matte, head_crop
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


def _ring(height: float, radii: tuple[float, float] = (0.06, 0.05)) -> torch.Tensor:
    """Points of an elliptic neck around the y axis at a height, in metres."""
    angles = torch.arange(48) * (2 * torch.pi / 48)
    return torch.stack([radii[0] * angles.cos(), torch.full((48,), height), radii[1] * angles.sin()], dim=-1)


def _camera_at(position: torch.Tensor) -> Camera:
    viewmat = look_at(position, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return replace(still_camera().to(torch.zeros(())), viewmat=viewmat)


def _neck_cut(turn: torch.Tensor | None = None):
    turn = torch.eye(3) if turn is None else turn
    vertices = torch.cat([_ring(-0.1), _ring(0.0)]) @ turn.mT
    return fit_neck_cut(NeckParts(torch.arange(48), torch.arange(48, 96)), vertices, turn[:, 1])


def test_neck_cut_is_a_plane_across_the_neck():
    turn = torch.linalg.qr(torch.tensor([[1.0, 0.2, 0.1], [0.0, 1.0, 0.4], [0.3, 0.0, 1.0]])).Q
    turn = turn * torch.linalg.det(turn).sign()
    cut = _neck_cut(turn)
    assert cut.axes[2] == pytest.approx(turn[:, 1].numpy(), abs=1e-5)
    assert cut.origin == pytest.approx((turn @ torch.tensor([0.0, -0.06, 0.0])).numpy(), abs=1e-5)
    assert cut.radii == pytest.approx((0.06, 0.05), abs=1e-5)
    points = torch.tensor([[0.3, -0.06, 0.1], [0.0, 0.04, 0.0], [0.1, -0.16, 0.2]])
    torch.testing.assert_close(cut.heights(points @ turn.mT), torch.tensor([0.0, 0.1, -0.1]))
    assert abs(cut.axes[0] @ turn[:, 0].numpy()) == pytest.approx(1, abs=1e-5)
    assert cut.axes @ cut.axes.T == pytest.approx(np.eye(3), abs=1e-6)


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (0.9, -0.45), (np.pi, 0.45)])
def test_all_cameras_cut_a_neck_at_the_same_place(yaw: float, pitch: float):
    """Points of the neck's skin are kept above the cut and cut off below it, wherever the camera is."""
    away = torch.tensor([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]).float()
    camera = _camera_at(away)
    keep = above_neck_cut(_neck_cut(), camera)
    for height, expected in ((-0.055, 1), (-0.065, 0)):
        points = _ring(height)
        normals = points / torch.tensor([0.06, torch.inf, 0.05]) ** 2
        faces_camera = ((camera.position - points) * normals).sum(-1) > 0.3 * normals.norm(dim=-1)
        assert 8 < int(faces_camera.sum()) < 28
        columns, rows = camera.project(points[faces_camera])[0].long().unbind(-1)
        assert (keep[rows, columns] == expected).all(), (height, keep[rows, columns])


def test_far_beside_the_neck_goes():
    camera = _camera_at(torch.tensor([0.0, 0.0, 1.0]))
    keep = above_neck_cut(_neck_cut(), camera)

    def at(x: float, y: float) -> float:
        column, row = camera.project(torch.tensor([[x, y, 0.0]]))[0][0].long().tolist()
        return float(keep[row, column])

    assert at(0.0, 0.0) == 1
    assert at(0.0, -0.08) == 0
    assert at(0.1, -0.05) == 0, "a shoulder that rises above the cut"
    assert at(0.1, 0.05) == 1, "hair beside the cheek"
    assert ((keep > 0) & (keep < 1)).any(), "borders are soft"


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
    grey = np.full((100, 100), 90, np.uint8)
    assert (cut_matte(grey, head, np.ones((100, 100), np.float32)) == 90).all(), "opacity is kept"


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
    vertices = model(face[0])[0]
    cut = fit_neck_cut(NeckParts.of(model), vertices, torch.tensor([0.0, 1.0, 0.0]))
    row = int(tracking.cameras[0].project(torch.from_numpy(cut.origin).float()[None])[0][0, 1])
    assert scoring.masks[0, 0, row - 10, SIZE // 2] == 255
    assert scoring.masks[0, 0, row + 20, SIZE // 2] == 0
    left, top, width, height = scoring.crops[0, 0]
    assert (left, top) == (0, 0)
    assert width == SIZE
    assert abs(top + height - row) < 15


def test_the_cut_line_keeps_what_is_above_the_line_of_each_picture_and_nothing_else():
    """`line` is the supplement's mask: a straight line in the picture, and no exception for what is below it."""
    model, face = _upright(2, roll=0.5)
    tracking = _tracking(model, face)
    capture = capture_of(torch.full((2, 478, 2), 100.0))
    scoring = make_scoring(capture, tracking, model, settings=ScoringSettings("line"))
    a, b, d = tracking.neck_lines[1, 0].double().numpy()
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    above = a * columns + b * rows + d
    assert abs(a) > 0.2, "the head is tilted, and so is the line"
    assert scoring.cut == "line"
    assert (scoring.masks[1, 0][above > 0.5] == 255).all()
    assert (scoring.masks[1, 0][above < -0.5] == 0).all()
    by_plane = make_scoring(capture, tracking, model)
    assert by_plane.cut == "plane"
    assert (by_plane.masks[1, 0] > scoring.masks[1, 0]).any() or (by_plane.masks[1, 0] < scoring.masks[1, 0]).any()


def test_overlay(tmp_path):
    """The overlay shows mesh and landmarks, and is written as a video."""
    model, face = _upright(3)
    tracking = _tracking(model, face)
    tracking = replace(tracking, residuals=torch.tensor([[0.5], [torch.nan], [0.5]]))
    capture = capture_of(torch.full((3, 478, 2), 100.0), missing=(1,))
    picture = OverlayPainter(capture, tracking, model).picture(0)
    assert picture.shape == (SIZE, 2 * SIZE, 3)
    assert (picture[256, SIZE + 256] != 128).any(), "the mesh is drawn"
    assert (picture[100, 100] == (60, 255, 60)).all(), "detected landmarks are green"
    write_overlay(tmp_path / "overlay.mp4", capture, tracking, model)
    assert (tmp_path / "overlay.mp4").stat().st_size > 1000
