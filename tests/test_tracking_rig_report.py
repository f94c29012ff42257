"""The report and the overlay of a calibrated rig: cameras at the side are no failures, and a wrong matrix is named."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.camera import Camera, look_at
from mien.capture import Capture
from mien.face import FaceModel
from mien.rotation import invert_rigid
from mien.tracking import Tracking, TrackingSettings, residual_report, track, write_residual_report
from mien.tracking.report import overlay
from mien.tracking.report.overlay import OverlayPainter
from mien.tracking.report.rig import seen_from_front, visible_landmarks
from small_face_model import make_small_face_model
from tracking_case import FOCAL, SIZE, make_tracking_case

YAWS = (-80, -30, 0, 30, 80)
NAMES = tuple(f"at{yaw}" for yaw in YAWS)


def camera_at(yaw: float) -> Camera:
    head, angle = torch.tensor([0.0, 0.0, -0.9]), math.radians(yaw)
    place = head + 0.9 * torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    return Camera(K, look_at(place, head, torch.tensor([0.0, 1.0, 0.0])), SIZE, SIZE)


@pytest.fixture(scope="module")
def model() -> FaceModel:
    return make_small_face_model()


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
        calibration=tuple(map(camera_at, YAWS)), principal_point=np.full((5, 2), SIZE / 2, np.float32),
    )  # fmt: skip


def tracked(capture: Capture, model: FaceModel) -> Tracking:
    return track(capture, model, TrackingSettings(schedule="landmarks"))


@pytest.fixture(scope="module")
def untroubled(rig: Capture, model: FaceModel) -> Tracking:
    return tracked(rig, model)


def test_cameras_at_the_side_are_no_failures(
    rig: Capture, untroubled: Tracking, model: FaceModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracking = untroubled
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
    assert rig.calibration is not None
    cameras = list(rig.calibration)
    viewmat = cameras[wrong].viewmat.clone()
    viewmat[1, 3] += 0.06
    cameras[wrong] = replace(cameras[wrong], viewmat=viewmat)
    capture = replace(rig, calibration=tuple(cameras))
    told = write_residual_report(tmp_path, capture, tracked(capture, model), model)
    assert told.count("Warning: camera") == 1
    assert f"Warning: camera {NAMES[wrong]} shows the face" in told
    assert "check its K, viewmat, id and offset" in (tmp_path / "report.html").read_text()


def with_cameras(rig: Capture, change: Callable[[Camera], Camera]) -> Capture:
    assert rig.calibration is not None
    return replace(rig, calibration=tuple(map(change, rig.calibration)))


@pytest.mark.unchecked
def test_cameras_that_misfit_together_are_warned_of(
    rig: Capture, model: FaceModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No camera and no frame stands out if all have a wrong focal length."""
    monkeypatch.setattr("mien.capture.reading_fit.INSIDE_OUT", -math.inf)  # The small model has no nose.
    longer = torch.tensor([[1.6], [1.6], [1.0]])

    def lengthened(camera: Camera) -> Camera:
        return replace(camera, K=torch.cat([camera.K[:, :2] * longer, camera.K[:, 2:]], 1))

    capture = with_cameras(rig, lengthened)
    told = write_residual_report(tmp_path, capture, tracked(capture, model), model)
    assert "Warning: all cameras together see landmarks" in told
    assert "check that K is in pixels of the whole picture" in told
    assert "No frame stands out." not in told
    assert "the calibration as a whole does not fit" in (tmp_path / "report.html").read_text()


@pytest.mark.unchecked
def test_a_calibration_that_fits_another_reading_is_warned_of_with_that_reading(
    rig: Capture, model: FaceModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mien.capture.reading_fit.INSIDE_OUT", -math.inf)  # The small model has no nose.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    world = invert_rigid(camera_at(YAWS[0]).viewmat) @ flip
    capture = with_cameras(rig, lambda camera: replace(camera, viewmat=invert_rigid(camera.viewmat @ world)))
    told = write_residual_report(tmp_path, capture, tracked(capture, model), model)
    assert "Warning: all cameras together see landmarks" in told
    assert "the matrices go from camera to world, so write the inverse of each viewmat" in told
