"""Tracking recovers the projected pose, expression and eyes, smooth without lag, also with gaps and bad input."""

from dataclasses import replace

import pytest
import torch

from mien.errors import UserError
from mien.face import load_face_model
from mien.rotation import matrix_from_axis_angle
from mien.tracking import TrackingSettings, residual_report, track
from mien.tracking.fitting.shot import initial_camera
from mien.tracking.landmarks.groups import landmark_weights
from mien.tracking.settings import PaperSettings, PhotometricSettings
from small_face_model import make_small_face_model
from tracking_case import FOCAL, capture_of, make_tracking_case

KNOWN_FOCAL = TrackingSettings(focal=FOCAL)


@pytest.fixture(scope="module")
def tracked():
    case = make_tracking_case(missing=(20, 21))
    return case, track(case.capture, make_small_face_model(), KNOWN_FOCAL)


@pytest.mark.unchecked
def test_recovers_the_truth(tracked):
    case, tracking = tracked
    face = tracking.face.to(case.pixels)
    turn = matrix_from_axis_angle(face.head_rotation) @ matrix_from_axis_angle(case.face.head_rotation).mT
    angle = ((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1).acos().rad2deg()
    assert angle.median() < 0.3
    # These are landmarks of the mesh itself, without noise and without any static offset.
    pixels = case.camera.project(case.model.landmark_positions(case.model(face), "mediapipe"))[0]
    assert (pixels - case.pixels).norm(dim=-1).median() < 0.3
    assert (face.expression - case.face.expression).abs().median() < 0.06
    assert (face.joints - case.face.joints).abs().median() < 0.02
    depth = face.head_translation[:, 2] / case.face.head_translation[:, 2]
    assert depth.std() < 0.003
    assert (depth.mean() - 1).abs() < 0.02


@pytest.mark.unchecked
def test_a_few_landmarks_will_do():
    case = make_tracking_case(timesteps=10)
    settings = replace(KNOWN_FOCAL, landmarks="ibug51")
    counted = landmark_weights("ibug51") > 0
    assert counted.sum() == 51 + 10
    moved = case.capture.landmarks.copy()
    moved[:, :, ~counted.numpy()] += 5
    captures = case.capture, replace(case.capture, landmarks=moved), case.capture
    few, same, again = (track(capture, make_small_face_model(), settings) for capture in captures)
    for name, tensor in few.face.tensors().items():
        assert torch.equal(tensor, again.face.tensors()[name]), f"{name} is not the same each time"
    pixels = case.camera.project(case.model.landmark_positions(case.model(few.face.to(case.pixels)), "mediapipe"))[0]
    assert (pixels - case.pixels).norm(dim=-1).median() < 0.8
    assert (few.face.expression - same.face.expression).abs().median() < 0.01


def _still_then_turn(noise: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return true yaw, tracked yaw and tracked landmarks (metres) of a head that rests, then turns 0.4 rad in 0.3 s."""
    case = make_tracking_case(timesteps=50, noise=0)
    yaw = 0.2 * torch.tanh((torch.arange(50, dtype=torch.float64) - 33) / 2.0)
    moving = replace(case.face[[0] * 50], head_rotation=yaw[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    pixels = case.camera.project(case.model.landmark_positions(case.model(moving), "mediapipe"))[0]
    generator = torch.Generator().manual_seed(5)
    # As with detectors, neighbours err alike: the picture shifts in each frame, and each point errs a little more.
    shake = noise * torch.randn(50, 1, 2, generator=generator, dtype=torch.float64)
    own = noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    model = make_small_face_model()
    tracking = track(capture_of(pixels + shake + own), model, KNOWN_FOCAL)
    return yaw, tracking.face.head_rotation[:, 1], model.landmark_positions(model(tracking.face), "mediapipe")


@pytest.mark.unchecked
def test_says_what_it_is_and_interpolates_missing_frames(tracked):
    case, tracking = tracked
    small = make_small_face_model()
    assert (tracking.face_model, tracking.face_model_hash) == ("small", small.content_hash)
    assert (len(tracking.face), tracking.neck_lines.shape, tracking.settings["focal"]) == (60, (60, 1, 3), FOCAL)
    torch.testing.assert_close(tracking.cameras[0].K.double(), case.camera.K, atol=0.01, rtol=0)
    # The median distance of points with 0.3 px of noise in each coordinate is 0.35 px.
    assert 0.3 < tracking.residuals.nanmedian() < 0.45
    assert tracking.valid.logical_not().nonzero()[:, 0].tolist() == [20, 21]
    assert tracking.residuals[20:22].isnan().all()
    for field in (tracking.face.head_translation, tracking.face.expression, tracking.face.head_rotation):
        torch.testing.assert_close(field[20], field[19] + (field[22] - field[19]) / 3)
    report = residual_report(case.capture, tracking, small)
    assert report["frames_without_face"] == [20, 21]
    assert report["residual_px"]["median"] == pytest.approx(float(tracking.residuals.nanmedian()), abs=1e-6)
    assert report["iris_distance"]["deviation_percent"] < 1.0
    assert report["jitter"]["fitted_px"] < report["jitter"]["detected_px"]
    assert report["flagged_frames"] == []
    residuals = tracking.residuals.clone()
    residuals[7] = 5.0
    assert residual_report(case.capture, replace(tracking, residuals=residuals), small)["flagged_frames"] == [7]


def test_expression_stays_in_bounds():
    case, model = make_tracking_case(timesteps=6), make_small_face_model()
    narrow = model.expression_bounds.clone()
    narrow[:4, 1] = 0.2
    found = track(case.capture, replace(model, expression_bounds=narrow), KNOWN_FOCAL).face.expression
    assert torch.equal(found, found.clamp(narrow[:, 0], narrow[:, 1]))
    assert (found[:, -1] == 0).all()
    assert (found[:, 1] == 0.2).any()


@pytest.mark.unchecked
def test_fast_turns_neither_lag_nor_shrink():
    still = _still_then_turn(noise=0.3)[2][2:26]
    shake = (still[2:] - 2 * still[1:-1] + still[:-2])[..., :2].norm(dim=-1).median()
    # The shake of the whole picture alone is 0.3 px * sqrt(6) * sqrt(pi / 2) in second differences, or 1.06 mm.
    assert shake < 0.0006
    yaw, tracked_yaw, _ = _still_then_turn(noise=0.0)
    tracked_yaw = tracked_yaw.double()
    range_ratio = (tracked_yaw.max() - tracked_yaw.min()) / (yaw.max() - yaw.min())
    assert 0.95 < range_ratio < 1.05
    # The yaw crosses the middle of its way less than half a frame late or early.
    centered = tracked_yaw - (tracked_yaw.max() + tracked_yaw.min()) / 2
    crossing = int((centered > 0).nonzero()[0, 0])
    exact = crossing - float(centered[crossing] / (centered[crossing] - centered[crossing - 1]))
    assert abs(exact - 33) < 0.5
    assert (tracked_yaw.diff().max() / yaw.diff().max()) > 0.85


def test_the_focal_length_follows_the_crop_and_a_square_counts_as_cut_out():
    capture = make_tracking_case(timesteps=3).capture
    crop = {"left": 300, "top": 0, "width": 1024, "height": 1024}
    cropped = replace(capture, source={"picture_size": [1920, 1080], "crop": crop})
    assert float(initial_camera(cropped, TrackingSettings()).K[0, 0]) == 1.5 * 1920 * 512 / 1024
    assert float(initial_camera(capture, TrackingSettings()).K[0, 0]) == pytest.approx(2.2 * 512)


def test_what_cannot_be_tracked_is_refused():
    case, model = make_tracking_case(timesteps=4, missing=(0, 1)), make_small_face_model()
    for capture, tracked_with, reason in (
        (capture_of(case.pixels, cameras=2), model, "2 cameras without calibration"),
        (case.capture, model, "found in 2 frames"),
        (make_tracking_case(timesteps=4).capture, replace(model, landmarks={}), "no MediaPipe landmarks"),
    ):
        with pytest.raises(UserError, match=reason):
            track(capture, tracked_with)


def test_anny_lips_and_lids_part():
    """The embedding tells the upper from the lower lip and lid. Otherwise no mouth would open in a tracking."""
    model = load_face_model("anny")
    face = model.neutral(3)
    face.expression[1, model.expression_names.index("jawOpen")] = 0.6
    face.expression[2, [model.expression_names.index(f"eyeBlink{side}") for side in ("Left", "Right")]] = 0.8
    marks = model.landmark_positions(model(face), "mediapipe")
    lips = (marks[:, [13, 82, 312]] - marks[:, [14, 87, 317]]).norm(dim=-1)
    assert lips[0].max() < 0.004
    assert lips[1].min() > 0.012
    lids = (marks[:, [159, 386]] - marks[:, [145, 374]]).norm(dim=-1)
    assert (lids[2] < 0.6 * lids[0]).all()


def test_settings_that_a_schedule_does_not_use_do_not_count():
    paper, sizes = PaperSettings(epochs=2), PhotometricSettings(sizes=(64,))
    asked = TrackingSettings(paper=paper, photometric=sizes)
    assert asked.in_effect() == TrackingSettings(photometric=sizes)
    assert replace(asked, schedule="landmarks").in_effect() == TrackingSettings(schedule="landmarks")
    assert replace(asked, schedule="paper").in_effect() == replace(asked, schedule="paper")
    alone = replace(asked, schedule="paper", paper=replace(paper, start="landmarks"))
    assert alone.in_effect() == replace(alone, photometric=PhotometricSettings())
