"""Faces fitted to pixels and outlines are better than landmarks alone. Unseen faces keep still."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.rotation import matrix_from_axis_angle
from mien.tracking import Tracking, TrackingSettings, residual_report, track, track_subject
from mien.tracking.fitting import Subject, Views, batch_of, layout_of
from mien.tracking.pixels.outline import OutlineTerm, edge_distances, outline_term
from mien.tracking.pixels.shared import move_like_keyframes
from mien.tracking.pixels.surface import surface_model
from mien.tracking.settings import PhotometricSettings
from photometric_case import FOCAL, SIZE, PhotometricCase, make_photometric_case, make_textured_model
from tracking_case import make_tracking_case

LANDMARKS = TrackingSettings(focal=FOCAL, schedule="landmarks")
FAST = replace(
    LANDMARKS, schedule="fast",
    photometric=PhotometricSettings(texture_size=128, keyframes=8, shared_steps=1),
)  # fmt: skip


@pytest.fixture(scope="module")
def case() -> PhotometricCase:
    return make_photometric_case()


@pytest.fixture(scope="module")
def by_landmarks(case: PhotometricCase) -> Tracking:
    return track(case.capture, case.model, LANDMARKS)


@pytest.fixture(scope="module")
def by_pixels(case: PhotometricCase) -> Tracking:
    return track(case.capture, case.model, FAST)


def wobble(case: PhotometricCase, tracking: Tracking) -> float:
    """Return the median deviation of landmarks from their mean error, in pixels."""
    points = case.model.landmark_positions(case.model(tracking.face), "mediapipe")
    error = tracking.cameras[0].project(points)[0] - case.landmarks
    return float((error - error.mean(0)).norm(dim=-1).median())


def turn_error(case: PhotometricCase, tracking: Tracking) -> float:
    """Return the median deviation of the rotation from its mean error, in degrees."""
    turn = matrix_from_axis_angle(tracking.face.head_rotation) @ matrix_from_axis_angle(case.face.head_rotation).mT
    vector = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], dim=-1)
    return float((vector - vector.mean(0)).norm(dim=-1).median().rad2deg())


@pytest.mark.unchecked
def test_pixels_calm_what_landmarks_leave(case, by_landmarks, by_pixels):
    assert wobble(case, by_pixels) < 0.5 * wobble(case, by_landmarks)
    assert turn_error(case, by_pixels) < 0.3


@pytest.mark.unchecked
def test_expressions_come_nearer_the_truth(case, by_landmarks, by_pixels):
    def error(tracking: Tracking) -> float:
        return float((tracking.face.expression - case.face.expression).abs().mean())

    assert error(by_pixels) < error(by_landmarks)


@pytest.mark.unchecked
def test_is_the_same_each_time_and_with_any_number_of_threads(case, by_pixels, monkeypatch):
    monkeypatch.setenv("MIEN_THREADS", "3")
    again = track(case.capture, case.model, FAST)
    for name, tensor in by_pixels.face.tensors().items():
        assert torch.equal(tensor, again.face.tensors()[name]), name


@pytest.mark.unchecked
def test_a_face_without_texture_stays_where_landmarks_put_it():
    case = make_tracking_case(timesteps=6)
    capture = replace(case.capture, images=np.full_like(case.capture.images, 128))
    model = make_textured_model()
    expected = track(capture, model, LANDMARKS)
    found = track(capture, model, FAST)
    marks = [model.landmark_positions(model(tracking.face), "mediapipe") for tracking in (expected, found)]
    assert (marks[0] - marks[1]).norm(dim=-1).median() < 0.0008


@pytest.mark.unchecked
def test_pictures_that_show_something_else_fall_back_to_landmarks_and_say_so(case, by_landmarks, capsys):
    images = np.array(case.capture.images)
    images[5] = np.random.default_rng(0).integers(0, 256, images[5].shape, np.uint8)
    mattes = np.array(case.capture.mattes)
    mattes[9] = 0
    found = track(replace(case.capture, images=images, mattes=mattes), case.model, FAST)
    assert found.pixel_residuals is not None
    without = found.pixel_residuals.isnan().all(1).nonzero()[:, 0].tolist()
    assert 9 in without
    assert len(without) <= 3
    printed = capsys.readouterr().err
    assert "fit to landmarks: 9" in printed or "5, 9" in printed
    report = residual_report(case.capture, found, case.model)
    assert report["landmarks_only_frames"] == without
    assert 5 in report["flagged_frames"] or 5 in without
    assert 2 not in report["flagged_frames"]
    kept = [case.model.landmark_positions(case.model(t.face[[5, 9]]), "mediapipe") for t in (found, by_landmarks)]
    assert (kept[0] - kept[1]).norm(dim=-1).median() < 0.003


@pytest.mark.unchecked
def test_sequences_of_one_subject_share_texture_and_identity(case):
    short = make_photometric_case(timesteps=7)
    found = track_subject([case.capture, short.capture], case.model, FAST)
    assert [len(tracking.face) for tracking in found] == [16, 7]
    assert torch.equal(found[0].face.identity, found[1].face.identity)
    for own, tracking in zip((case, short), found, strict=True):
        assert wobble(own, tracking) < 0.2
        assert tracking.pixel_residuals is not None
        assert tracking.pixel_residuals.median() < 0.06


@pytest.mark.unchecked
def test_residuals_tell_how_well_colors_agree(by_pixels, by_landmarks):
    assert by_landmarks.pixel_residuals is None
    assert by_pixels.pixel_residuals.isfinite().all()
    assert 0 < by_pixels.pixel_residuals.median() < 0.06


@pytest.mark.unchecked
def test_a_model_without_texture_coordinates_is_tracked_by_landmarks_and_says_so(capsys):
    case = make_tracking_case(timesteps=4)
    tracking = track(case.capture, case.model.to(torch.zeros(())), FAST)
    assert tracking.pixel_residuals is None
    assert "the fit to landmarks is kept" in capsys.readouterr().err
    expected = track(case.capture, case.model.to(torch.zeros(())), LANDMARKS)
    assert torch.equal(tracking.face.head_rotation, expected.face.head_rotation)


def test_derivatives_of_the_surface_are_those_of_the_face_model():
    model = make_textured_model()
    generator = torch.Generator().manual_seed(0)
    pose_basis = 0.002 * torch.randn(27, *model.template.shape, generator=generator)
    model = replace(model, pose_basis=pose_basis)
    layout = layout_of(model)
    state = 0.3 * torch.rand(layout.size, generator=generator, dtype=torch.float64)
    state[3:6] = torch.tensor([0.02, 0.03, -0.8])
    state = torch.minimum(torch.maximum(state, layout.lower), layout.upper)
    identity = torch.randn(len(model.identity_basis), generator=generator, dtype=torch.float64)
    exact = replace(model, joint_identity_basis=0 * model.joint_identity_basis).to(torch.zeros(()).double())
    surface = surface_model(exact, layout)

    def vertices(both: torch.Tensor) -> torch.Tensor:
        return exact(layout.face_params(both[None, : layout.size], both[layout.size :]))[0]

    both = torch.cat([state, identity])
    posed = surface.pose(state, identity, derive_identity=True)
    assert posed.jacobian is not None
    torch.testing.assert_close(posed.vertices.double(), vertices(both), atol=1e-6, rtol=0)
    assert posed.jacobian.shape[2] == len(both)
    for index, step in enumerate(1e-5 * torch.eye(len(both), dtype=torch.float64)):
        expected = (vertices(both + step) - vertices(both - step)) / 2e-5
        difference = (posed.jacobian[..., index] - expected).abs().max()
        assert difference < 2e-4 * expected.abs().max() + 1e-7, index


# Outlines -------------------------------------------------------------------------------------------------------------


def term_of(case: PhotometricCase) -> OutlineTerm:
    rows = torch.arange(len(case.face))
    views = Views(case.landmarks.double(), rows, torch.zeros_like(rows), torch.ones(len(rows), dtype=torch.float64))
    return outline_term(surface_model(case.model, layout_of(case.model)), case.capture, rows, views, 10.0)


def true_state(case: PhotometricCase) -> torch.Tensor:
    layout, face = layout_of(case.model), case.face
    expression = face.expression[:, layout.expression_index]
    joints = face.joints.flatten(1)[:, layout.joint_index]
    return torch.cat([face.head_rotation, face.head_translation, expression, joints], dim=1).double()


def step_of(case: PhotometricCase, state: torch.Tensor, columns: slice) -> torch.Tensor:
    """Return the Gauss-Newton step of some parameters of each timestep."""
    subject = Subject(case.face.identity.double(), torch.zeros(478, 3).double())
    rows = torch.arange(len(state))
    frames, _ = term_of(case).joint_equations(state, rows, subject, batch_of((case.camera,)))
    return -torch.linalg.solve(frames.hessian[:, columns, columns], frames.gradient[:, columns])


@pytest.fixture(scope="module")
def short_case() -> PhotometricCase:
    return make_photometric_case(timesteps=8)


def test_the_true_outline_lies_where_the_matte_ends(short_case):
    vertices = short_case.model(short_case.face)
    for timestep in range(len(short_case.face)):
        outline = term_of(short_case).outline(vertices[timestep], short_case.camera)
        distances = edge_distances(short_case.capture.mattes[timestep, 0], outline, 8.0)
        assert len(distances) > 20
        assert float(distances.nanmedian().abs()) < 0.3


def test_normals_point_outwards_with_length_1(short_case):
    outline = term_of(short_case).outline(short_case.model(short_case.face)[0], short_case.camera)
    middle = outline.points.mean(0)
    assert torch.allclose(outline.normals.norm(dim=1), torch.ones(len(outline.points)), atol=1e-5)
    assert (((outline.points - middle) * outline.normals).sum(1) > 0).float().mean() > 0.9


def test_a_shifted_head_is_pulled_back(short_case):
    truth = true_state(short_case)
    shift = torch.tensor([0.003, -0.002], dtype=torch.float64)  # 1.2 and 0.8 pixels
    state = truth.clone()
    state[:, 3:5] += shift
    left = state[:, 3:5] + step_of(short_case, state, slice(3, 5)) - truth[:, 3:5]
    assert float(left.norm(dim=1).mean()) < 0.3 * float(shift.norm())


def test_what_is_out_of_reach_does_not_count(short_case):
    outline = term_of(short_case).outline(short_case.model(short_case.face)[0], short_case.camera)
    hair = np.full((SIZE, SIZE), 255, np.uint8)
    assert edge_distances(hair, outline, 8.0).isnan().all()
    capture = replace(short_case.capture, mattes=np.full_like(short_case.capture.mattes, 255))
    subject = Subject(short_case.face.identity.double(), torch.zeros(478, 3).double())
    term, camera = replace(term_of(short_case), capture=capture), batch_of((short_case.camera,))
    frames, shared = term.joint_equations(true_state(short_case), torch.arange(3), subject, camera)
    assert not frames.hessian.any()
    assert not shared.gradient.any()


@pytest.mark.unchecked
def test_outlines_bring_the_focal_length_nearer_the_truth(short_case):
    def focal_error(weight: float) -> float:
        photometric = replace(FAST.photometric, texture_size=64, outline_weight=weight)
        settings = TrackingSettings(photometric=photometric)
        found = float(track(short_case.capture, short_case.model, settings).cameras[0].K[0, 0])
        return abs(np.log(found / float(short_case.camera.K[0, 0])))

    assert focal_error(40.0) < 0.8 * focal_error(0.0)


def test_timesteps_between_keyframes_move_as_these_do():
    random = torch.Generator().manual_seed(4)
    state = torch.randn(40, 9, generator=random, dtype=torch.float64)
    slopes = torch.randn(6, 6, generator=random, dtype=torch.float64)
    step = torch.cat([0.3 + 0.1 * state[:, :6] @ slopes, torch.ones(40, 3).double()], dim=1)
    keyframes = torch.arange(0, 40, 2)
    moved = move_like_keyframes(state, keyframes, step[keyframes])
    assert torch.equal(moved[:, 6:], state[:, 6:])
    wrong = (moved - state - step)[1::2, :6].norm(dim=1)
    assert float(wrong.mean()) < 0.2 * float((step - step.mean(0))[1::2, :6].norm(dim=1).mean())
