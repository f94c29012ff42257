"""Tracking recovers the projected pose, expression and eyes, also with gaps, several sequences or several cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.camera import look_at
from mien.capture.capture import Capture
from mien.face import FaceModel, FaceParams, load_face_model
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle, rigid_transform
from mien.tracking import read_tracking, track, track_subject
from mien.tracking import write_tracking as write
from mien.tracking.fitting.sequence import initial_camera
from mien.tracking.landmarks.groups import landmark_weights
from mien.tracking.report.overlay import frontal_camera
from mien.tracking.report.residuals import residual_report
from mien.tracking.settings import PaperSettings, PhotometricSettings, TrackingSettings
from mien.tracking.tracking import Tracking
from refusals import refuses
from small_face_model import make_small_face_model
from tracking_case import FOCAL, FPS, SIZE, capture_of, make_tracking_case, still_camera

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
    assert ((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1).acos().rad2deg().median() < 0.3
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


def _turned() -> tuple[torch.Tensor, torch.Tensor]:
    """Return the true and the tracked yaw of a head that rests, then turns 0.4 rad in 0.3 s."""
    case = make_tracking_case(timesteps=50, noise=0)
    yaw = 0.2 * torch.tanh((torch.arange(50, dtype=torch.float64) - 33) / 2.0)
    moving = replace(case.face[[0] * 50], head_rotation=yaw[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    pixels = case.camera.project(case.model.landmark_positions(case.model(moving), "mediapipe"))[0]
    tracking = track(capture_of(pixels), make_small_face_model(), KNOWN_FOCAL)
    return yaw, tracking.face.head_rotation[:, 1].double()


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
    yaw, tracked_yaw = _turned()
    range_ratio = (tracked_yaw.max() - tracked_yaw.min()) / (yaw.max() - yaw.min())
    assert 0.95 < range_ratio < 1.05
    # The yaw crosses the middle of its way less than half a frame late or early.
    centered = tracked_yaw - (tracked_yaw.max() + tracked_yaw.min()) / 2
    crossing = int((centered > 0).nonzero()[0, 0])
    exact = crossing - float(centered[crossing] / (centered[crossing] - centered[crossing - 1]))
    assert abs(exact - 33) < 0.5
    assert (tracked_yaw.diff().max() / yaw.diff().max()) > 0.85


def test_the_focal_length_follows_the_crop_and_settings_out_of_use_do_not_count():
    capture = make_tracking_case(timesteps=3).capture
    crop = {"left": 300, "top": 0, "width": 1024, "height": 1024}
    cropped = replace(capture, source={"picture_size": [1920, 1080], "crop": crop})
    assert float(initial_camera(cropped, TrackingSettings()).K[0, 0]) == 1.5 * 1920 * 512 / 1024
    assert float(initial_camera(capture, TrackingSettings()).K[0, 0]) == pytest.approx(2.2 * 512)
    paper, sizes = PaperSettings(start="fast", epochs=2), PhotometricSettings(sizes=(64,))
    asked = TrackingSettings(landmarks="mediapipe", paper=paper, photometric=sizes)
    bare = TrackingSettings(landmarks="mediapipe", paper=PaperSettings("fast", pass_smoothness=0.0))
    assert replace(asked, landmarks="auto").in_effect() == replace(bare, photometric=sizes)
    assert replace(asked, schedule="landmarks").in_effect() == replace(bare, schedule="landmarks")
    assert replace(asked, schedule="paper").in_effect() == replace(asked, schedule="paper")
    alone = replace(asked, schedule="paper", paper=replace(paper, start="landmarks"))
    assert alone.in_effect() == replace(alone, photometric=PhotometricSettings())


def test_what_cannot_be_tracked_is_refused():
    case, model = make_tracking_case(timesteps=4, missing=(0, 1)), make_small_face_model()
    for capture, tracked_with, reason in (
        (capture_of(case.pixels, cameras=2), model, "2 cameras without calibration"),
        (case.capture, model, "found in 2 frames"),
        (make_tracking_case(timesteps=4).capture, replace(model, landmarks={}), "no MediaPipe landmarks"),
    ):
        refuses(reason, track, capture, tracked_with)


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


FEW = TrackingSettings(keyframes=8)
"""Settings that are quicker than the default, and good enough for these tests."""
DOUBLE = torch.zeros((), dtype=torch.float64)
_LENS = 1.4
"""Factor on the focal length of `tracking_case`."""


def _noisy(pixels: torch.Tensor, noise: float, seed: int) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return pixels + noise * torch.randn(pixels.shape, generator=random, dtype=torch.float64)


def _landmarks(model: FaceModel, face: FaceParams) -> torch.Tensor:
    model = model.to(DOUBLE)
    return model.landmark_positions(model(face.to(DOUBLE)), "mediapipe")


def _film(yaw: tuple[float, float], start: int, name: str) -> tuple[Capture, FaceParams]:
    """Return a dozen noisy frames of a head that turns from one angle to another."""
    case = make_tracking_case(timesteps=60, noise=0)
    face = case.face[slice(start, start + 12)]
    rotation = face.head_rotation.clone()
    rotation[:, 1] = torch.linspace(*yaw, 12)
    # At this distance the head fills pictures of this lens, about as tracking assumes for square pictures.
    away = face.head_translation * torch.tensor([1, 1, _LENS])
    face = replace(face, head_rotation=rotation, head_translation=away)
    K = case.camera.K * torch.tensor([[_LENS, 1, 1], [1, _LENS, 1], [1, 1, 1]])
    pixels = replace(case.camera, K=K).project(_landmarks(case.model, face))[0]
    return replace(capture_of(_noisy(pixels, 2.0, start)), name=name), face


@pytest.mark.unchecked
@pytest.mark.slow
def test_sequences_of_a_subject_have_one_identity():
    ahead, truth = _film((-0.1, 0.1), 0, "ahead")
    model, aside = make_small_face_model(), _film((0.5, 0.7), 24, "aside")[0]
    half = {name: getattr(aside, name)[:, :, ::2, ::2] for name in ("images", "mattes")}
    aside = replace(
        aside, **half, landmarks=aside.landmarks / 2, principal_point=aside.principal_point / 2, fps=30.0
    )  # fmt: skip

    def shape_error(tracking: Tracking) -> float:
        """Return the RMS distance of the rest vertices from the true ones, without shift and scale, in millimetres."""
        rest = [model(replace(model.neutral(1), identity=one.identity.float()))[0] for one in (tracking.face, truth)]
        rest = [vertices - vertices.mean(0) for vertices in rest]
        rest = [vertices / vertices.norm() * model.template.norm() for vertices in rest]
        return 1000 * float((rest[0] - rest[1]).norm(dim=1).square().mean().sqrt())

    together = track_subject([ahead, aside], model, FEW)
    assert torch.equal(together[0].face.identity, together[1].face.identity)
    assert [len(tracking.face) for tracking in together] == [12, 12]
    assert [tracking.cameras[0].width for tracking in together] == [SIZE, SIZE // 2]
    assert together[0].face.head_rotation[:, 1].abs().max() < 0.2, "every sequence has its own motion"
    assert together[1].face.head_rotation[:, 1].min() > 0.4
    alone = [track(capture, model, FEW) for capture in (ahead, aside)]
    assert not torch.equal(alone[0].face.identity, alone[1].face.identity)
    assert shape_error(together[0]) < 0.8 * min(map(shape_error, alone))
    again = track_subject([aside, ahead], model, FEW)[1]
    torch.testing.assert_close(again.face.identity, together[0].face.identity, atol=1e-4, rtol=0)
    alike = track_subject([ahead, aside], model, replace(FEW, same_camera=True))
    for found, same in ((alike, True), (together, False)):
        first, second = (float(tracking.cameras[0].K[0, 0]) for tracking in found)
        assert (first == pytest.approx(2 * second, rel=1e-6)) == same


def _model_with_sizes() -> FaceModel:
    """Return the small face model with one more identity: the size of the head, 6 % per standard deviation."""
    model = make_small_face_model()
    basis = torch.cat([model.identity_basis, 0.06 * model.template[None]])
    joint_basis = torch.cat([model.joint_identity_basis, 0.06 * model.joint_template[None]])
    return replace(model, identity_basis=basis, joint_identity_basis=joint_basis)


def _z_up() -> torch.Tensor:
    """Return T_other_world for a world in which z is up and the head looks along -x. Its rotation vectors are long."""
    R_other_world = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    return rigid_transform(R_other_world, torch.tensor([0.3, -0.2, 1.5], dtype=torch.float64))


@pytest.fixture(scope="module")
def ring():
    """Return a face with a size of its own, what a ring of three cameras sees of it, and its tracking."""
    case = make_tracking_case(timesteps=20, noise=0)
    pose = (T_other_world := _z_up()) @ case.face.T_world_head
    face = replace(
        case.face, identity=torch.cat([case.face.identity, torch.tensor([1.2]).double()]),
        head_rotation=axis_angle_from_matrix(pose[:, :3, :3]), head_translation=pose[:, :3, 3],
    )  # fmt: skip
    center, up = torch.tensor([0.0, 0.0, -0.9]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
    cameras = []
    for angle in torch.tensor([0.0, -0.7, 0.8]).double():  # to the subject's left
        position = center + 0.9 * torch.stack([angle.sin(), angle * 0, angle.cos()])
        viewmat = look_at(position, center, up) @ torch.linalg.inv(T_other_world)
        cameras.append(replace(still_camera(), viewmat=viewmat))
    points = _landmarks(_model_with_sizes(), face)
    seen = _noisy(torch.stack([camera.project(points)[0] for camera in cameras], dim=1), 0.3, 7)
    landmarks, valid = seen.numpy().astype(np.float32), np.ones((20, 3), bool)
    valid[5, [0, 2]], valid[:8, 1], valid[12, 2] = False, False, False
    landmarks[~valid] = np.nan
    shape = (20, 3, SIZE // 4, SIZE // 4)
    capture = Capture(
        name="ring", camera_ids=("cam0", "cam1", "cam2"), fps=FPS, timestamps=np.arange(20) / FPS,
        images=np.full((*shape, 3), 128, np.uint8), mattes=np.full(shape, 255, np.uint8), landmarks=landmarks,
        valid=valid, principal_point=np.full((3, 2), SIZE / 2, np.float32), source={},
        calibration=tuple(camera.to(torch.zeros(())) for camera in cameras),
    )  # fmt: skip
    return face, capture, track(capture, _model_with_sizes(), FEW)


def _pose_errors(face: FaceParams, tracking: Tracking) -> tuple[float, float]:
    """Return medians over timesteps of the rotation error in degrees and of the landmarks' error in millimetres."""
    found = tracking.face.to(DOUBLE)
    turn = matrix_from_axis_angle(found.head_rotation) @ matrix_from_axis_angle(face.head_rotation).mT
    angle = axis_angle_from_matrix(turn).norm(dim=1).rad2deg()
    model = _model_with_sizes()
    distance = (_landmarks(model, found) - _landmarks(model, face)).norm(dim=-1)
    return float(angle.median()), 1000 * float(distance.median())


@pytest.mark.unchecked
def test_cameras_tell_pose_and_metric_scale(ring):
    face, capture, tracking = ring
    first = {name: getattr(capture, name)[:, :1] for name in ("landmarks", "valid", "images", "mattes")}
    alone = replace(
        capture, **first, camera_ids=("cam0",), principal_point=capture.principal_point[:1],
        calibration=capture.calibration[:1],
    )  # fmt: skip
    single = track(alone, _model_with_sizes(), FEW)
    angle, distance = _pose_errors(face, tracking)
    angle_alone, distance_alone = _pose_errors(face, single)
    assert angle < 0.15 < 1.5 * angle_alone
    assert distance < 0.5 < 10 < distance_alone, "one camera cannot tell a large head from a near one"
    assert abs(float(tracking.face.identity[-1]) - 1.2) < 0.05
    assert abs(float(single.face.identity[-1]) - 1.2) > 0.5
    shifted = replace(capture, landmarks=capture.landmarks + np.array([0, 0, 1], np.float32)[:, None, None] * [0, 4])
    assert _pose_errors(face, track(shifted, _model_with_sizes(), FEW))[1] < 0.8


def test_what_a_ring_of_cameras_tells(ring, tmp_path):
    _, capture, tracking = ring
    for given, kept in zip(capture.calibration, tracking.cameras, strict=True):
        assert torch.equal(given.K, kept.K)
        assert torch.equal(given.viewmat, kept.viewmat)
    assert torch.equal(tracking.residuals.isfinite(), torch.from_numpy(capture.valid)), "blind cameras add nothing"
    assert tracking.residuals.nanmedian() < 0.5
    assert tracking.neck_lines.shape == (20, 3, 3)
    assert tracking.valid.logical_not().nonzero()[:, 0].tolist() == [5], "nobody saw it"
    between = (tracking.face.head_translation[4] + tracking.face.head_translation[6]) / 2
    torch.testing.assert_close(tracking.face.head_translation[5], between, atol=1e-5, rtol=0)
    assert tracking.face.head_rotation.norm(dim=1).max() > 2, "the case is meant to be near a half turn"
    assert tracking.face.head_rotation.diff(dim=0).norm(dim=1).max() < 0.3
    report = residual_report(capture, tracking, _model_with_sizes())
    assert report["cameras"]["cam1"]["frames"] == 12
    assert report["cameras"]["cam1"]["residual_px"]["median"] < 0.5
    assert (report["flagged_frames"], frontal_camera(tracking)) == ([], 0)
    assert report["depth_m"]["median"] == pytest.approx(0.9, abs=0.05)
    write(tmp_path, tracking)
    again = read_tracking(tmp_path)
    assert torch.equal(again.residuals.isnan(), tracking.residuals.isnan())
    assert torch.equal(again.cameras[2].viewmat, tracking.cameras[2].viewmat)
