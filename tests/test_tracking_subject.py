"""Several sequences or calibrated cameras of one subject share one identity, and one face per timestep."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.camera import Camera, look_at
from mien.capture import Capture
from mien.face import FaceModel, FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle, rigid_transform
from mien.tracking import Tracking, TrackingSettings, read_tracking, residual_report, track, track_subject
from mien.tracking import write_tracking as write
from mien.tracking.report.overlay import frontal_camera
from small_face_model import make_small_face_model
from tracking_case import FOCAL, FPS, SIZE, capture_of, make_tracking_case, still_camera

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


# Sequences ------------------------------------------------------------------------------------------------------------


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


def _with_half_the_pixels(capture: Capture) -> Capture:
    return replace(
        capture, landmarks=capture.landmarks / 2, images=capture.images[:, :, ::2, ::2],
        mattes=capture.mattes[:, :, ::2, ::2], principal_point=capture.principal_point / 2, fps=30.0,
    )  # fmt: skip


def _shape_error(truth: FaceParams, tracking: Tracking) -> float:
    """Return the RMS distance of the rest vertices from the true ones, without shift and scale, in millimetres."""
    model = make_small_face_model()

    def at_rest(identity: torch.Tensor) -> torch.Tensor:
        vertices = model(replace(model.neutral(1), identity=identity.float()))[0]
        vertices = vertices - vertices.mean(0)
        return vertices / vertices.norm() * model.template.norm()

    distances = (at_rest(tracking.face.identity) - at_rest(truth.identity)).norm(dim=1)
    return 1000 * float(distances.square().mean().sqrt())


@pytest.fixture(scope="module")
def two_sequences():
    ahead, truth = _film((-0.1, 0.1), 0, "ahead")
    aside, _ = _film((0.5, 0.7), 24, "aside")
    captures = [ahead, _with_half_the_pixels(aside)]
    return captures, truth, track_subject(captures, make_small_face_model(), FEW)


@pytest.mark.unchecked
@pytest.mark.slow
def test_sequences_of_a_subject_have_one_identity(two_sequences):
    captures, truth, together = two_sequences
    assert torch.equal(together[0].face.identity, together[1].face.identity)
    assert [len(tracking.face) for tracking in together] == [12, 12]
    assert [tracking.cameras[0].width for tracking in together] == [SIZE, SIZE // 2]
    assert together[0].face.head_rotation[:, 1].abs().max() < 0.2, "every sequence has its own motion"
    assert together[1].face.head_rotation[:, 1].min() > 0.4
    alone = [track(capture, make_small_face_model(), FEW) for capture in captures]
    assert not torch.equal(alone[0].face.identity, alone[1].face.identity)
    assert _shape_error(truth, together[0]) < 0.8 * min(_shape_error(truth, tracking) for tracking in alone)


@pytest.mark.unchecked
@pytest.mark.slow
def test_the_order_of_sequences_does_not_matter(two_sequences):
    captures, _, (first, _) = two_sequences
    _, again = track_subject(captures[::-1], make_small_face_model(), FEW)
    torch.testing.assert_close(again.face.identity, first.face.identity, atol=1e-4, rtol=0)


@pytest.mark.unchecked
def test_focal_lengths_are_shared_only_if_asked(two_sequences):
    captures, _, apart = two_sequences
    alike = track_subject(captures, make_small_face_model(), replace(FEW, same_camera=True))
    first, second = (float(tracking.cameras[0].K[0, 0]) for tracking in alike)
    assert first == pytest.approx(2 * second, rel=1e-6)
    first, second = (float(tracking.cameras[0].K[0, 0]) for tracking in apart)
    assert first != pytest.approx(2 * second, rel=1e-6)


# Cameras --------------------------------------------------------------------------------------------------------------


def _model_with_sizes() -> FaceModel:
    """Return the small face model with one more identity: the size of the head, 6 % per standard deviation."""
    model = make_small_face_model()
    return replace(
        model,
        identity_basis=torch.cat([model.identity_basis, 0.06 * model.template[None]]),
        joint_identity_basis=torch.cat([model.joint_identity_basis, 0.06 * model.joint_template[None]]),
    )


def _z_up() -> torch.Tensor:
    """Return T_other_world for a world in which z is up and the head looks along -x. Its rotation vectors are long."""
    R_other_world = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    return rigid_transform(R_other_world, torch.tensor([0.3, -0.2, 1.5], dtype=torch.float64))


def _moved(face: FaceParams, T_other_world: torch.Tensor) -> FaceParams:
    pose = T_other_world @ face.T_world_head
    return replace(face, head_rotation=axis_angle_from_matrix(pose[:, :3, :3]), head_translation=pose[:, :3, 3])


def _ring(angles: tuple[float, ...], T_other_world: torch.Tensor) -> tuple[Camera, ...]:
    """Return cameras 0.9 m from a head at (0, 0, -0.9), at angles in radians to the subject's left."""
    center, up = torch.tensor([0.0, 0.0, -0.9]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
    cameras = []
    for angle in torch.tensor(angles).double():
        position = center + 0.9 * torch.stack([angle.sin(), angle * 0, angle.cos()])
        viewmat = look_at(position, center, up) @ torch.linalg.inv(T_other_world)
        cameras.append(replace(still_camera(), viewmat=viewmat))
    return tuple(camera.to(torch.zeros(())) for camera in cameras)


def _multi_capture(face: FaceParams, cameras: tuple[Camera, ...], blind: dict[int, tuple[int, ...]]) -> Capture:
    """Return what calibrated cameras detect. `blind` gives, for each camera, the timesteps without a face."""
    points = _landmarks(_model_with_sizes(), face)
    seen = torch.stack([camera.to(DOUBLE).project(points)[0] for camera in cameras], dim=1)
    landmarks = _noisy(seen, 0.3, 7).numpy().astype(np.float32)
    valid = np.ones(landmarks.shape[:2], bool)
    for camera, timesteps in blind.items():
        valid[list(timesteps), camera] = False
    landmarks[~valid] = np.nan
    shape = (*valid.shape, SIZE // 4, SIZE // 4)
    return Capture(
        name="ring", camera_ids=tuple(f"cam{index}" for index in range(len(cameras))), fps=FPS,
        timestamps=np.arange(len(landmarks)) / FPS, images=np.full((*shape, 3), 128, np.uint8),
        mattes=np.full(shape, 255, np.uint8), landmarks=landmarks, valid=valid,
        principal_point=np.full((len(cameras), 2), SIZE / 2, np.float32), source={}, calibration=cameras,
    )  # fmt: skip


@pytest.fixture(scope="module")
def ring():
    case = make_tracking_case(timesteps=20, noise=0)
    size = torch.tensor([1.2]).double()
    face = _moved(replace(case.face, identity=torch.cat([case.face.identity, size])), _z_up())
    cameras = _ring((0.0, -0.7, 0.8), _z_up())
    capture = _multi_capture(face, cameras, {0: (5,), 1: tuple(range(8)), 2: (5, 12)})
    return face, capture, track(capture, _model_with_sizes(), FEW)


def _one_camera(capture: Capture) -> Capture:
    assert capture.calibration is not None
    return replace(
        capture, camera_ids=("cam0",), landmarks=capture.landmarks[:, :1], valid=capture.valid[:, :1],
        images=capture.images[:, :1], mattes=capture.mattes[:, :1], principal_point=capture.principal_point[:1],
        calibration=capture.calibration[:1],
    )  # fmt: skip


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
    single = track(_one_camera(capture), _model_with_sizes(), FEW)
    angle, distance = _pose_errors(face, tracking)
    angle_alone, distance_alone = _pose_errors(face, single)
    assert angle < 0.15 < 1.5 * angle_alone
    assert distance < 0.5 < 10 < distance_alone, "one camera cannot tell a large head from a near one"
    assert abs(float(tracking.face.identity[-1]) - 1.2) < 0.05
    assert abs(float(single.face.identity[-1]) - 1.2) > 0.5


@pytest.mark.unchecked
def test_cameras_from_the_side_are_believed_less(ring):
    """Cameras from the side count less, since a detector errs in other ways on a face from the side."""
    face, capture, _ = ring
    landmarks = capture.landmarks.copy()
    landmarks[:, 2] += (0, 4)
    _, distance = _pose_errors(face, track(replace(capture, landmarks=landmarks), _model_with_sizes(), FEW))
    assert distance < 0.8


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
    write(tmp_path, tracking)
    again = read_tracking(tmp_path)
    assert torch.equal(again.residuals.isnan(), tracking.residuals.isnan())
    assert torch.equal(again.cameras[2].viewmat, tracking.cameras[2].viewmat)


def test_report_of_several_cameras(ring):
    _, capture, tracking = ring
    report = residual_report(capture, tracking, _model_with_sizes())
    assert report["cameras"]["cam1"]["frames"] == 12
    assert report["cameras"]["cam1"]["residual_px"]["median"] < 0.5
    assert report["flagged_frames"] == []
    assert frontal_camera(tracking) == 0
    assert report["depth_m"]["median"] == pytest.approx(0.9, abs=0.05)


@pytest.mark.unchecked
@pytest.mark.slow
def test_rings_and_videos_share_an_identity(ring):
    face, capture, _ = ring
    case = make_tracking_case(timesteps=20, noise=0)
    points = _landmarks(_model_with_sizes(), replace(case.face, identity=face.identity))
    video = capture_of(_noisy(case.camera.project(points)[0], 0.3, 3))
    _, of_video = track_subject([capture, video], _model_with_sizes(), replace(FEW, focal=FOCAL))
    assert abs(float(of_video.face.identity[-1]) - 1.2) < 0.05, "the ring tells the video's metric scale"
