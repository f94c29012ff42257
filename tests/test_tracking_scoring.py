"""Neck line and scoring mask decide what is scored. Trackings and masks survive round trips and report damage."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from capture_helpers import tree_bytes
from damage import edit_json
from mien.camera import look_at
from mien.disk.files import read_json, read_tensors, write_tensors
from mien.errors import UserError
from mien.tracking import read_tracking, scoring_files, write_tracking
from mien.tracking.neck_cut import NeckParts, above_neck_cut, fit_neck_cut
from mien.tracking.neck_line import bottom_vertices, fit_neck_lines, project_neck_line
from mien.tracking.report.overlay import OverlayPainter, write_overlay
from mien.tracking.scoring import Scoring, cut_matte, head_crop, make_scoring
from mien.tracking.tracking import Appearance, Tracking
from refusals import refuses
from small_face_model import make_small_face_model
from tracking_case import SIZE, capture_of, still_camera


def _upright(timesteps: int = 1, roll: float = 0.0):
    model = make_small_face_model()
    translation, rotation = torch.tensor([0.0, 0.0, -0.9]), torch.tensor([0.0, 0.0, roll])
    return model, replace(
        model.neutral(timesteps), head_translation=translation.repeat(timesteps, 1),
        head_rotation=rotation.repeat(timesteps, 1),
    )  # fmt: skip


CAMERA = still_camera().to(torch.zeros(()))


def _tracking(model, face) -> Tracking:
    return Tracking(
        "small", model.content_hash, face, torch.ones(len(face), dtype=torch.bool), (CAMERA,),
        fit_neck_lines(model, face, (CAMERA,)), torch.zeros(len(face), 1),
    )  # fmt: skip


def test_neck_line_of_an_upright_head():
    model, face = _upright()
    bottom = bottom_vertices(model)
    assert len(bottom) == 28
    assert (model.template[bottom, 1] < model.template[:, 1].min() + 1e-4).all()
    a, b, d = fit_neck_lines(model, face, (CAMERA,))[0, 0].tolist()
    assert (a, b) == pytest.approx((0, -1), abs=1e-3)
    assert d == pytest.approx(float(CAMERA.project(model(face)[0, bottom])[0][:, 1].mean()), abs=1)
    x, y = CAMERA.project(face.head_translation)[0][0].tolist()
    assert a * x + b * y + d > 50, "the head is above its neck"
    for roll in (-0.4, 0.3, 1.7):
        line = fit_neck_lines(*_upright(roll=roll), (CAMERA,))[0, 0]
        # World y up is picture y down: up leans to the left for a positive roll.
        assert line[:2].tolist() == pytest.approx([-np.sin(roll), -np.cos(roll)], abs=2e-2)
    twice = {name: getattr(model, name).repeat_interleave(2, 0) for name in ("faces", "uv_faces", "face_regions")}
    with pytest.raises(AssertionError, match="closed"):
        bottom_vertices(replace(model, **twice))


def test_the_neck_line_is_one_line_in_space_that_every_camera_projects():
    """The base of this neck is deeper than wide, so a line fitted in a picture from above would run along the neck."""
    model, face = _upright(roll=0.2)
    bottom, head = model(face)[0, bottom_vertices(model)], face.T_world_head[0]
    center, sideways, up = torch.tensor([0.0, 0.0, -0.9]), torch.tensor([0.0, 1.0, 0.0]), head[:3, 1]
    for away in ((0.0, 0.2, 1.0), (0.5, 0.8, 0.6), (-0.6, -0.3, 0.8), (0.2, 0.3, -1.0)):
        camera = replace(CAMERA, viewmat=look_at(center + torch.tensor(away), center, sideways))
        line = project_neck_line(bottom, head, camera)
        points = bottom.mean(0) + torch.tensor([[-0.1], [0.0], [0.1]]) * head[:3, 0]
        heights = camera.project(torch.cat([points, points + 0.1 * up]))[0] @ line[:2] + line[2]
        assert heights[:3].abs().max() < 0.05, away
        assert heights[3:].min() > 10, "the head is above it"
    for away in ((1.0, 0.2, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.5, 0.1)):
        side = replace(CAMERA, viewmat=look_at(center + torch.tensor(away), center, sideways))
        assert abs(float(project_neck_line(bottom, head, side)[0])) < 0.3, "level, where the line would run upwards"


def _ring(height: float, radii: tuple[float, float] = (0.06, 0.05)) -> torch.Tensor:
    """Points of an elliptic neck around the y axis at a height, in metres."""
    angles = torch.arange(48) * (2 * torch.pi / 48)
    return torch.stack([radii[0] * angles.cos(), torch.full((48,), height), radii[1] * angles.sin()], dim=-1)


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
    away = torch.tensor([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]).float()
    camera = replace(CAMERA, viewmat=look_at(away, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])))
    keep = above_neck_cut(_neck_cut(), camera)
    for height, expected in ((-0.055, 1), (-0.065, 0)):
        points = _ring(height)
        normals = points / torch.tensor([0.06, torch.inf, 0.05]) ** 2
        faces_camera = ((camera.position - points) * normals).sum(-1) > 0.3 * normals.norm(dim=-1)
        assert 8 < int(faces_camera.sum()) < 28
        columns, rows = camera.project(points[faces_camera])[0].long().unbind(-1)
        assert (keep[rows, columns] == expected).all(), (height, keep[rows, columns])
    assert ((keep > 0) & (keep < 1)).any(), "borders are soft"
    if yaw == 0:  # the last: a shoulder that rises above the cut, and hair beside the cheek
        places = torch.tensor([[0.0, 0.0, 0.0], [0.0, -0.08, 0.0], [0.1, -0.05, 0.0], [0.1, 0.05, 0.0]])
        columns, rows = camera.project(places)[0].long().unbind(-1)
        assert keep[rows, columns].tolist() == [1, 0, 0, 1]


def test_bowed_chin_stays_and_slivers_go():
    matte, keep, head = np.full((100, 100), 255, np.uint8), np.zeros((100, 100), np.float32), np.zeros((100, 100), bool)
    keep[:50] = 1
    head[20:60, 50:70] = True
    matte[:, 30:40] = 0
    mask = cut_matte(matte, head, keep)
    assert mask[55, 60] == 255, "the chin below the line"
    assert (mask[55, 80], mask[30, 80]) == (0, 255)
    assert mask[30, 10] == 0, "a part that the matte does not join to the head"
    assert (cut_matte(0 * matte + 90, head, 0 * keep + 1) == 90).all(), "opacity is kept"
    mask = np.zeros((50, 60), np.uint8)
    mask[10:30, 20:25] = 255
    mask[0, 0] = 3
    assert head_crop(mask).tolist() == [20, 10, 5, 20]
    assert head_crop(0 * mask).tolist() == [0, 0, 60, 50]


def test_scoring_keeps_what_is_above_the_line_of_each_picture_and_nothing_else():
    model, face = _upright(2)
    scoring = make_scoring(capture_of(torch.full((2, 478, 2), 100.0)), _tracking(model, face), model)
    assert (scoring.masks.shape, scoring.cut) == ((2, 1, SIZE, SIZE), "plane")
    cut = fit_neck_cut(NeckParts.of(model), model(face[0])[0], torch.tensor([0.0, 1.0, 0.0]))
    row = int(CAMERA.project(torch.from_numpy(cut.origin).float()[None])[0][0, 1])
    assert scoring.masks[0, 0, [row - 10, row + 20], SIZE // 2].tolist() == [255, 0]
    left, top, width, height = scoring.crops[0, 0]
    assert (left, top, width) == (0, 0, SIZE)
    assert abs(height - row) < 15
    # `line` is the supplement's mask: a straight line in the picture, and no exception for what is below it.
    model, face = _upright(2, roll=0.5)
    tracking, capture = _tracking(model, face), capture_of(torch.full((2, 478, 2), 100.0))
    scoring = make_scoring(capture, tracking, model, cut="line")
    bottom, across = model(face)[1, bottom_vertices(model)].mean(0), 0.05 * face.T_world_head[1, :3, 0]
    (x, y), (right, down) = CAMERA.project(torch.stack([bottom - across, bottom + across]))[0].double().numpy()
    a, b = (down - y, x - right) / np.hypot(right - x, down - y)
    d = -a * x - b * y
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    above = a * columns + b * rows + d
    assert abs(a) > 0.2, "the head is tilted, and so is the line"
    assert scoring.cut == "line"
    assert (scoring.masks[1, 0][above > 0.5] == 255).all()
    assert (scoring.masks[1, 0][above < -0.5] == 0).all()
    assert (make_scoring(capture, tracking, model).masks[1, 0] != scoring.masks[1, 0]).any()


def test_overlay(tmp_path):
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


def stored(all_of_it: bool = False) -> Tracking:
    """Return a tracking, with vertex offsets and a fit to pixels on demand."""
    model, random = make_small_face_model(), torch.Generator().manual_seed(0)
    face = replace(model.neutral(4), head_rotation=torch.randn(4, 3, generator=random))
    tracking = Tracking(
        face_model="small", face_model_hash="abc", face=face, valid=torch.tensor([True, False, True, True]),
        cameras=(still_camera().to(torch.zeros(())),), neck_lines=torch.tensor([0.0, -1.0, 300.0]).expand(4, 1, 3),
        residuals=torch.tensor([[0.5], [torch.nan], [0.7], [0.6]]), settings={"focal": None, "keyframes": 20},
    )  # fmt: skip
    if not all_of_it:
        return tracking
    texture, trust, light = (torch.rand(*shape, generator=random) for shape in ((8, 6, 3), (8, 6), (9, 3)))
    return replace(
        tracking, face=replace(face, vertex_offsets=torch.randn(model.template.shape, generator=random)),
        pixel_residuals=torch.tensor([[0.02], [torch.nan], [torch.nan], [0.03]]),
        appearance=Appearance(texture, trust, light, sigma=0.03, light_extent=0.012),
    )  # fmt: skip


@pytest.mark.parametrize("all_of_it", [False, True])
def test_round_trip(tmp_path, all_of_it):
    """What is read is written again to the same bytes."""
    write_tracking(tmp_path / "one", stored(all_of_it))
    write_tracking(tmp_path / "two", read_tracking(tmp_path / "one"))
    assert tree_bytes(tmp_path / "one") == tree_bytes(tmp_path / "two")
    tensors = read_tensors(tmp_path / "two" / "tracking.safetensors")
    assert torch.equal(tensors["head_rotation"], stored().face.head_rotation)
    assert ("vertex_offsets" in tensors, "texture" in tensors) == (all_of_it, all_of_it)
    summary = json.loads((tmp_path / "two" / "tracking.json").read_text())["residual"]
    assert summary["median_px"] == pytest.approx(0.6)


@pytest.mark.parametrize(("change", "message"), [
    (lambda t: t.pop("joints"), "lacks 'joints'"),
    (lambda t: t.update(expression=t["expression"][:2]), "'head_rotation'|'joints'|'expression'"),
    (lambda t: t.update(head_translation=torch.full((4, 3), torch.nan)), "'head_translation' holds numbers"),
    (lambda t: t.update(residuals=torch.full((4, 1), torch.nan)), "'residuals' holds numbers"),
    (lambda t: t.update(camera_K=torch.zeros(1, 2, 3)), "'camera_K' has the shape"),
])  # fmt: skip
def test_wrong_content(tmp_path, change, message):
    """The json is kept in step, so that the content is found to be wrong, not the hash."""
    write_tracking(tmp_path, stored())
    file = tmp_path / "tracking.safetensors"
    tensors = read_tensors(file)
    change(tensors)
    write_tensors(file, tensors)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    edit_json(tmp_path / "tracking.json", lambda content: content.update(tensors_sha256=digest))
    refuses(message, read_tracking, tmp_path)


def _scoring(value: int = 200) -> Scoring:
    masks = np.zeros((2, 1, 8, 10), np.uint8)
    masks[:, :, 2:6, 3:9] = value
    return Scoring(masks, np.array([[[3, 2, 6, 4]], [[3, 2, 6, 4]]]))


def test_scoring_round_trip_and_frozen(tmp_path):
    """The hash of a scoring covers masks and crops. Figures of other runs name it, so it must not change."""
    folder = tmp_path / "scoring"
    (folder / "masks").mkdir(parents=True)
    assert not scoring_files.scoring_exists(folder), "half written"
    scoring_files.write_scoring(folder, _scoring(), "a1")
    assert scoring_files.scoring_exists(folder)
    again = scoring_files.read_scoring(folder)
    np.testing.assert_array_equal(again.masks, _scoring().masks)
    np.testing.assert_array_equal(again.crops, _scoring().crops)
    digest = hashlib.sha256(_scoring().masks.tobytes() + _scoring().crops.astype(np.int32).tobytes()).hexdigest()
    assert scoring_files.read_scoring_hash(folder) == digest
    before = tree_bytes(folder)
    scoring_files.write_scoring(folder, _scoring(value=100), "a1")
    assert tree_bytes(folder) == before
    assert list(tmp_path.iterdir()) == [folder], "no scratch folder stays behind"


def test_masks_keep_their_cut(tmp_path):
    folder = tmp_path / "scoring"
    scoring_files.check_scoring_cut(folder, "line", "a1")
    scoring_files.write_scoring(folder, replace(_scoring(), cut="line"), "a1")
    assert read_json(folder / "scoring.json", "mien.scoring", 1, "")["cut"] == "line"
    assert scoring_files.read_scoring(folder).cut == "line"
    scoring_files.check_scoring_cut(folder, "line", "a1")
    scoring_files.check_scoring_cut(folder, "plane", "b2")  # masks of other pictures are made again
    with pytest.raises(UserError, match=r"--scoring.cut plane: .*give --scoring.cut line, or delete that folder"):
        scoring_files.check_scoring_cut(folder, "plane", "a1")
    edit_json(folder / "scoring.json", lambda content: content.update(cut="circle"))
    refuses(r"cut 'circle' is not plane, line or none; delete the folder", scoring_files.read_scoring, folder)


def test_damaged_scoring(tmp_path):
    """A mask of other pixels, which is a whole picture. `test_damage` has the others."""
    scoring_files.write_scoring(tmp_path / "s", _scoring(), "a1")
    scoring_files.write_scoring(tmp_path / "other", _scoring(value=100), "a1")
    shutil.copy(tmp_path / "other/masks/00/000001.png", tmp_path / "s/masks/00")
    refuses("have changed since they were written", scoring_files.read_scoring, tmp_path / "s")
