"""Pictures of a tracking are right: renderings, heat, overlay, contact sheet, and the report's page, also of a rig."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mien.camera import Camera, look_at
from mien.capture.capture import Capture
from mien.face import FaceModel
from mien.machine.parallel import stream_in_threads
from mien.media.pictures import heat_colors
from mien.media.video import probe_video
from mien.render.mesh import shade
from mien.rotation import invert_rigid, matrix_from_axis_angle
from mien.tracking import track
from mien.tracking.pixels.outcome import appearance_in_world, model_pictures, turn_light
from mien.tracking.pixels.pictures import window_of
from mien.tracking.pixels.texture import SkinTexture, even_light
from mien.tracking.report import overlay
from mien.tracking.report.contact_sheet import name_of, sheet_frames, tiles_of, worst_of_runs
from mien.tracking.report.overlay import HOTTEST, OverlayPainter, overlay_stride, write_overlay
from mien.tracking.report.page import findings, name_runs, write_residual_report
from mien.tracking.report.residuals import residual_report
from mien.tracking.report.rig import seen_from_front, visible_landmarks
from mien.tracking.settings import PhotometricSettings, TrackingSettings
from mien.tracking.tracking import Appearance, Tracking
from photometric_case import FOCAL, SIZE, PhotometricCase, make_photometric_case, smooth_noise
from small_face_model import make_small_face_model
from tracking_case import make_tracking_case, still_camera

FAST = TrackingSettings(focal=FOCAL, photometric=PhotometricSettings(texture_size=128, keyframes=8, shared_steps=1))


case = pytest.fixture(scope="module")(lambda: make_photometric_case(timesteps=6))


@pytest.fixture(scope="module")
def truth(case: PhotometricCase) -> Tracking:
    """Return a fit with the texture that the pictures were drawn with, and without shading."""
    texture = smooth_noise(256, 256, 4.0)
    return Tracking(
        face_model=case.model.name, face_model_hash="", face=case.face, valid=torch.ones(6, dtype=torch.bool),
        cameras=(case.camera,), neck_lines=torch.tensor([0.0, -1.0, 120.0]).expand(6, 1, 3),
        residuals=torch.full((6, 1), 0.5), pixel_residuals=torch.full((6, 1), 0.01),
        appearance=Appearance(texture, torch.ones(256, 256), even_light(), sigma=0.02, light_extent=0.02),
        settings={"schedule": "fast"},
    )  # fmt: skip


def test_the_true_model_looks_like_the_pictures(case, truth):
    pictures = model_pictures(case.capture, truth, case.model)
    assert pictures is not None
    vertices = case.model(case.face)[2]
    compared = pictures.compare(2, 0, vertices)
    known = compared.difference.isfinite()
    assert known.float().mean() > 0.2
    assert compared.difference[known].median() < 0.03
    assert compared.rms < 0.04
    part = torch.from_numpy(case.capture.images[2, 0][compared.window.rows, compared.window.columns] / np.float32(255))
    assert (compared.image - part)[known].abs().median() < 0.03, "the model's picture is not of the same place"
    elsewhere = pictures.compare(2, 0, vertices + torch.tensor([0.01, 0.0, 0.0]))
    assert elsewhere.rms > 2 * compared.rms, "a shift by four pixels is not seen"
    for shift in ([5.0, 0.0, 0.0], [0.0, 0.0, 3.0]):
        outside = pictures.compare(2, 0, vertices + torch.tensor(shift))
        assert np.isnan(outside.rms)
        assert outside.difference.isnan().all()
    assert window_of(case.camera, torch.full((3, 3), 9.0)).rows.stop <= SIZE


def test_turned_light_falls_on_turned_normals_alike():
    random, T_world_fit = torch.Generator().manual_seed(0), torch.eye(4).double()
    light, normals = torch.randn(9, 3, generator=random), torch.randn(20, 3, generator=random)
    normals = torch.nn.functional.normalize(normals, dim=1)
    T_world_fit[:3, :3] = R_world_fit = matrix_from_axis_angle(torch.tensor([0.4, -1.0, 0.3]))
    turned = turn_light(light, R_world_fit)
    torch.testing.assert_close(shade(normals @ R_world_fit.T, turned), shade(normals, light), atol=1e-5, rtol=0)
    appearance = appearance_in_world(SkinTexture(torch.zeros(2, 2, 3), torch.ones(2, 2), 0.1), light, T_world_fit)
    torch.testing.assert_close(appearance.light, turned, atol=1e-5, rtol=0)


def test_the_overlay_shows_where_colors_differ(case, truth, tmp_path):
    off = truth.face.head_translation.clone()
    off[3] += torch.tensor([0.01, 0.0, 0.0])
    painter = OverlayPainter(case.capture, replace(truth, face=replace(truth.face, head_translation=off)), case.model)
    assert painter.picture(3).shape == (2 * SIZE, 2 * SIZE, 3)
    good, bad = (painter.panels(timestep)[3].astype(int).sum(-1)[painter.head_box(timestep)] for timestep in (2, 3))
    assert bad.mean() > 1.3 * good.mean()
    write_overlay(tmp_path / "overlay.mp4", case.capture, truth, case.model, every=4)
    assert probe_video(tmp_path / "overlay.mp4").frames == 2
    assert probe_video(tmp_path / "overlay.mp4").fps == pytest.approx(case.capture.fps / 4)
    plain = OverlayPainter(case.capture, replace(truth, appearance=None, pixel_residuals=None), case.model)
    assert plain.picture(0).shape == (SIZE, 2 * SIZE, 3), "two panels without looks"
    assert [overlay_stride(timesteps) for timesteps in (1, 120, 121, 15000)] == [1, 1, 2, 125]
    heat = heat_colors(np.array([[0.0, 0.03, 0.08, 0.15, 9.0, np.nan]], np.float32), HOTTEST).astype(int).sum(-1)[0]
    assert heat[5] == heat[0] < heat[1] < heat[2] < heat[3] == heat[4]


def test_results_come_in_order_and_few_wait(monkeypatch):
    monkeypatch.setenv("MIEN_THREADS", "3")
    started, lock = [], threading.Lock()

    def double(item: int) -> int:
        with lock:
            started.append(item)
        return 2 * item

    stream = stream_in_threads(double, range(50))
    assert [next(stream), next(stream)] == [0, 2]
    assert len(started) <= 2 + 3 + 2 + 1, "all are made at once: long clips do not fit"
    assert list(stream) == [2 * item for item in range(2, 50)]


def test_the_sheet_has_what_stands_out(case, truth):
    residuals = truth.pixel_residuals.clone()
    residuals[4], residuals[1] = 0.2, torch.nan
    odd = replace(truth, pixel_residuals=residuals)
    frames = sheet_frames(odd, flagged=[3, 4], alone=[1])
    assert [frame.timestep for frame in frames] == sorted({frame.timestep for frame in frames})
    assert [name_of(case.capture, frame) for frame in frames if frame.why] == [
        "Frame 1, landmarks only", "Frame 4, flagged"
    ]  # fmt: skip
    painter = OverlayPainter(case.capture, odd, case.model)
    assert [tile.shape for tile in tiles_of(painter, case.capture, frames[0])] == [(240, 240, 3)] * 4
    assert worst_of_runs([2, 3, 7], np.array([0, 0, 1, 5, 0, 0, 0, 3.0])) == [3, 7]
    assert name_runs([3, 7, 8, 9, 12]) == "3, 7-9, 12"


@pytest.mark.unchecked
@pytest.mark.parametrize(("schedule", "appearance", "alone", "said"), [
    ("fast", True, 0, "Pixels were used in all 6 frames"),
    ("fast", True, 2, "Pixels did not improve 2 of 6 frames with a face, so landmarks alone determined them: 0-1."),
    ("fast", False, 6, "landmarks alone determined all frames"),
    ("landmarks", False, 6, "fitted to landmarks alone"),
])  # fmt: skip
def test_the_page_says_aloud_what_decided(case, truth, tmp_path, schedule, appearance, alone, said):
    residuals = truth.pixel_residuals.clone()
    residuals[:alone] = torch.nan
    shown = replace(
        truth, settings={"schedule": schedule}, appearance=truth.appearance if appearance else None,
        pixel_residuals=residuals if appearance else None,
    )  # fmt: skip
    assert said in write_residual_report(tmp_path, case.capture, shown, case.model)
    page = (tmp_path / "report.html").read_text()
    assert said in page
    panels = 4 if appearance else 2
    assert page.count("data:image/") == panels * page.count('<figure class="card">') + 1, "all panels, and the poster"
    assert page.index("<video") < page.index("Findings")
    assert page.count("<svg") == (5 if appearance else 4)
    found = findings(shown, residual_report(case.capture, shown, case.model))
    odd = " ".join(text for kind, text in found if kind == "odd")
    assert said.split(" so ")[0] in odd or schedule == "landmarks" or alone == 0


@pytest.mark.unchecked
def test_calibrated_cameras_in_another_world_are_compared_too(case, tmp_path):
    W_other = torch.eye(4)
    W_other[:3, :3] = matrix_from_axis_angle(torch.tensor([0.3, 1.2, -0.2]))
    W_other[:3, 3] = torch.tensor([1.0, 2.0, -0.5])
    camera = replace(case.camera, viewmat=case.camera.viewmat @ torch.linalg.inv(W_other))
    slope = np.linspace(0.5, 1.2, SIZE, dtype=np.float32)[:, None]
    images = np.clip(case.capture.images * slope, 0, 255).astype(np.uint8)
    both = {name: np.repeat(getattr(case.capture, name), 2, axis=1) for name in ("mattes", "landmarks", "valid")}
    capture = replace(
        case.capture, **both, images=np.repeat(images, 2, axis=1), camera_ids=("a", "b"), calibration=(camera, camera),
        principal_point=np.repeat(case.capture.principal_point, 2, axis=0),
    )  # fmt: skip
    tracking: Any = track(capture, case.model, FAST)
    light = turn_light(tracking.appearance.light, W_other[:3, :3].T)
    unturned, vertices = replace(tracking.appearance, light=light), case.model(tracking.face[3])[0]
    looks = (tracking, replace(tracking, appearance=unturned))
    both: Any = [model_pictures(capture, each, case.model) for each in looks]
    found, wrong = ([pictures.compare(3, index, vertices).rms for index in (0, 1)] for pictures in both)
    assert found[0] == found[1]
    assert found[0] == pytest.approx(float(tracking.pixel_residuals[3, 0]), rel=0.3)
    assert wrong[0] > 1.02 * found[0]
    write_overlay(tmp_path / "overlay.mp4", capture, tracking, case.model, every=3)
    assert probe_video(tmp_path / "overlay.mp4").frames == 2
    write_residual_report(tmp_path, capture, tracking, case.model)
    assert (tmp_path / "report.html").is_file()


YAWS = (-80, -30, 0, 30, 80)
LANDMARKS = TrackingSettings(schedule="landmarks")
NAMES = tuple(f"at{yaw}" for yaw in YAWS)


def camera_at(yaw: float) -> Camera:
    head, angle = torch.tensor([0.0, 0.0, -0.9]), math.radians(yaw)
    place = head + 0.9 * torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    return replace(still_camera().to(torch.zeros(())), viewmat=look_at(place, head, torch.tensor([0.0, 1.0, 0.0])))


model = pytest.fixture(scope="module")(lambda: make_small_face_model())


@pytest.fixture(scope="module")
def rig(model: FaceModel) -> Capture:
    """Five cameras around a head. As a detector does, they misplace the landmarks that they do not see."""
    case = make_tracking_case(timesteps=6, noise=0.2)
    face = case.face.to(torch.zeros(()))
    face = replace(face, head_rotation=0.3 * face.head_rotation)
    vertices, random = model(face), np.random.default_rng(0)
    marks = model.landmark_positions(vertices, "mediapipe")
    seen = []
    for camera in map(camera_at, YAWS):
        pixels = camera.project(marks)[0].numpy() + random.normal(0, 0.3, (6, marks.shape[1], 2))
        pixels[~visible_landmarks(model, vertices, camera).numpy()] += 25
        seen.append(pixels)
    many = {name: np.repeat(getattr(case.capture, name), 5, axis=1) for name in ("images", "mattes", "valid")}
    return replace(
        case.capture, **many, landmarks=np.stack(seen, 1).astype(np.float32), camera_ids=NAMES,
        calibration=tuple(map(camera_at, YAWS)), principal_point=np.repeat(case.capture.principal_point, 5, axis=0),
    )  # fmt: skip


def told_of(rig: Capture, model: FaceModel, folder: Path, change: Callable[[Camera], Camera]) -> tuple[str, str]:
    """Return what a tracking by changed cameras prints, and its page."""
    assert rig.calibration is not None
    capture = replace(rig, calibration=tuple(map(change, rig.calibration)))
    told = write_residual_report(folder, capture, track(capture, model, LANDMARKS), model)
    return told, (folder / "report.html").read_text()


def test_cameras_at_the_side_are_no_failures(rig: Capture, model: FaceModel, tmp_path: Path, monkeypatch) -> None:
    tracking = track(rig, model, LANDMARKS)
    assert seen_from_front(tracking).tolist() == [[False, True, True, True, False]] * 6
    report = residual_report(rig, tracking, model)
    assert report["shared_misfit"] is None
    assert report["cameras"]["at80"]["residual_px"]["median"] > 2 * report["residual_px"]["max"], "guesses look bad"
    assert report["cameras"]["at80"]["from_front"] == 0
    assert max(row["misplaced_px"] for row in report["cameras"].values()) < 6
    assert "Warning" not in write_residual_report(tmp_path, rig, tracking, model)
    painter = OverlayPainter(rig, tracking, model)
    assert painter.caption(2, 4) == "at80 2: from the side"
    assert painter.caption(2, 2).endswith(" px")
    drawn: list[int] = []
    monkeypatch.setattr(overlay, "draw_points", lambda _, points, __: drawn.append(len(points)))
    for index in (2, 4):
        painter.panels(2, index)
    assert drawn[0] == drawn[1] > 1.2 * drawn[2] == 1.2 * drawn[3] > 0, "hidden landmarks are not drawn"


@pytest.mark.unchecked
@pytest.mark.parametrize("wrong", [1, 4])
def test_a_camera_with_a_wrong_matrix_is_named(rig: Capture, model: FaceModel, tmp_path: Path, wrong: int) -> None:
    cameras: Any = rig.calibration
    up = 0.06 * torch.tensor([[0.0] * 4, [0, 0, 0, 1], [0.0] * 4, [0.0] * 4])

    def moved(camera: Camera) -> Camera:
        return replace(camera, viewmat=camera.viewmat + up) if camera is cameras[wrong] else camera

    told, page = told_of(rig, model, tmp_path, moved)
    assert told.count("Warning: camera") == 1
    assert f"Warning: camera {NAMES[wrong]} shows the face" in told
    assert "check its K, viewmat, id and offset" in page


@pytest.mark.unchecked
def test_cameras_that_misfit_together_are_warned_of(rig: Capture, model: FaceModel, tmp_path, monkeypatch) -> None:
    """No camera and no frame stands out if all have a wrong focal length."""
    monkeypatch.setattr("mien.capture.cameras.readings.INSIDE_OUT", -math.inf)  # The small model has no nose.
    longer = torch.tensor([[1.6, 1, 1], [1, 1.6, 1], [1, 1, 1]])
    told, page = told_of(rig, model, tmp_path, lambda camera: replace(camera, K=camera.K * longer))
    assert "Warning: all cameras together see landmarks" in told
    assert "check that K is in pixels of the whole picture" in told
    assert "No frame stands out." not in told
    assert "the calibration as a whole does not fit" in page
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world = invert_rigid(camera_at(YAWS[0]).viewmat) @ flip
    told, _ = told_of(rig, model, tmp_path, lambda each: replace(each, viewmat=invert_rigid(each.viewmat @ world)))
    assert "Warning: all cameras together see landmarks" in told
    assert "the matrices go from camera to world, so write the inverse of each viewmat" in told
