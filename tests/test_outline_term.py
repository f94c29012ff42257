"""Outlines of heads are found, agree with the truth, and pull a fit towards it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.tracking import TrackingSettings, track
from mien.tracking.fitting import Subject, Views, batch_of, layout_of
from mien.tracking.pixels.outline import OutlineTerm, edge_distances, outline_term
from mien.tracking.pixels.shared import move_like_keyframes
from mien.tracking.pixels.surface import surface_model
from photometric_case import SIZE, PhotometricCase, make_photometric_case

pytestmark = pytest.mark.unchecked


@pytest.fixture(scope="module")
def case() -> PhotometricCase:
    return make_photometric_case(timesteps=8)


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


def test_the_true_outline_lies_where_the_matte_ends(case):
    vertices = case.model(case.face)
    for timestep in range(len(case.face)):
        outline = term_of(case).outline(vertices[timestep], case.camera)
        distances = edge_distances(case.capture.mattes[timestep, 0], outline, 8.0)
        assert len(distances) > 20
        assert float(distances.nanmedian().abs()) < 0.3


def test_normals_point_outwards_with_length_1(case):
    outline = term_of(case).outline(case.model(case.face)[0], case.camera)
    middle = outline.points.mean(0)
    assert torch.allclose(outline.normals.norm(dim=1), torch.ones(len(outline.points)), atol=1e-5)
    assert (((outline.points - middle) * outline.normals).sum(1) > 0).float().mean() > 0.9


def test_a_shifted_head_is_pulled_back(case):
    truth = true_state(case)
    shift = torch.tensor([0.003, -0.002], dtype=torch.float64)  # 1.2 and 0.8 pixels
    state = truth.clone()
    state[:, 3:5] += shift
    left = state[:, 3:5] + step_of(case, state, slice(3, 5)) - truth[:, 3:5]
    assert float(left.norm(dim=1).mean()) < 0.3 * float(shift.norm())


def test_what_is_out_of_reach_does_not_count(case):
    outline = term_of(case).outline(case.model(case.face)[0], case.camera)
    hair = np.full((SIZE, SIZE), 255, np.uint8)
    assert edge_distances(hair, outline, 8.0).isnan().all()
    capture = replace(case.capture, mattes=np.full_like(case.capture.mattes, 255))
    frames, shared = replace(term_of(case), capture=capture).joint_equations(
        true_state(case), torch.arange(3), Subject(case.face.identity.double(), torch.zeros(478, 3).double()),
        batch_of((case.camera,)),
    )  # fmt: skip
    assert not frames.hessian.any()
    assert not shared.gradient.any()


def test_outlines_bring_the_focal_length_nearer_the_truth(case):
    def focal_error(weight: float) -> float:
        settings = TrackingSettings()
        settings = replace(settings, photometric=replace(settings.photometric, outline_weight=weight))
        found = float(track(case.capture, case.model, settings).cameras[0].K[0, 0])
        return abs(np.log(found / float(case.camera.K[0, 0])))

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
