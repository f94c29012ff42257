"""The model of the landmark detector is fitted and stored, and tracking gains from it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mien.errors import UserError
from mien.face import load_face_model
from mien.lab.synthetic.detector_calibration import Sightings, fit_response
from mien.tracking.fitting import CameraBatch, Fit, SequenceFit, Views, batch_of, layout_of
from mien.tracking.landmarks import DetectorResponse, all_landmarks, read_response, reduce_face_model, write_response
from mien.tracking.landmarks.detector_response import unknown_response
from mien.tracking.landmarks.shared_fit import fit_shared
from mien.tracking.landmarks.term import move_subject, unknown_subject
from mien.tracking.settings import TrackingSettings
from small_face_model import make_small_face_model
from tracking_case import still_camera

_POINTS = 478


def _some_response(expressions: int, people: int = 3, seed: int = 0) -> DetectorResponse:
    random = torch.Generator().manual_seed(seed)

    def offsets(*shape: int) -> torch.Tensor:
        return 0.001 * torch.randn(*shape, _POINTS, 3, generator=random, dtype=torch.float64)

    return DetectorResponse(offsets(), offsets(2), offsets(expressions), offsets(people), 0.0004)


def test_what_ships_is_plausible():
    model = load_face_model("anny")
    response = read_response(model, 0.003)
    assert response.by_expression.shape == (len(model.expression_names), _POINTS, 3)
    assert len(response.by_person) == 40
    assert 0.0003 < response.mean.norm(dim=1).mean() < 0.003, "some millimetres at most"
    spread = response.by_person.square().sum(0).mean().sqrt()
    assert response.rest_sigma < 0.5 * spread < 0.002, "components explain people that they were not made of"


def test_a_file_is_read_as_it_was_written(tmp_path, monkeypatch):
    model = make_small_face_model()
    response = _some_response(len(model.expression_names))
    path = tmp_path / "small_detector.npz"
    write_response(path, model, response, 5)
    monkeypatch.setattr("mien.tracking.landmarks.detector_response.response_path", lambda *which: path)
    read = read_response(model, 0.003)
    for name in ("mean", "by_turn", "by_expression", "by_person"):
        torch.testing.assert_close(getattr(read, name), getattr(response, name), atol=3e-6, rtol=0)
    assert read.rest_sigma == pytest.approx(response.rest_sigma)
    other = replace(model, faces=model.faces.flip(0))
    assert len(read_response(other, 0.002).by_person) == 0, "measured on another mesh"
    assert read_response(other, 0.002).rest_sigma == 0.002


def test_another_detector_has_what_people_differ_by_from_mediapipe(tmp_path, monkeypatch):
    model = make_small_face_model()
    ours, theirs = (_some_response(len(model.expression_names), seed=seed) for seed in (0, 1))
    where = "mien.tracking.landmarks.detector_response.response_path"
    monkeypatch.setattr(where, lambda name, detector="mediapipe": tmp_path / f"{name}_{detector}.npz")
    write_response(tmp_path / f"{model.name}_litert.npz", model, theirs, 5, "litert")
    assert len(read_response(model, 0.003, "litert").by_person) == 0, "nothing is known without mediapipe's file"
    write_response(tmp_path / f"{model.name}_mediapipe.npz", model, ours, 5)
    read = read_response(model, 0.003, "litert")
    for name, expected in (("mean", theirs), ("by_turn", theirs), ("by_expression", ours), ("by_person", ours)):
        torch.testing.assert_close(getattr(read, name), getattr(expected, name), atol=3e-6, rtol=0)


def _people(truth: DetectorResponse, count: int, pictures: int = 30) -> list[Sightings]:
    random = torch.Generator().manual_seed(7)
    people = []
    for _ in range(count):
        turns = 0.4 * torch.randn(pictures, 3, generator=random)
        R_seen = torch.matrix_exp(
            torch.linalg.cross(turns[:, None].expand(-1, 3, 3), torch.eye(3).expand(pictures, 3, 3))
        )
        expression = torch.rand(pictures, len(truth.by_expression), generator=random)
        habits = torch.cat([turns[:, :2], expression], dim=1)
        person = torch.randn(len(truth.by_person), generator=random)
        offset = truth.mean.float() + torch.einsum("k,klc->lc", person, truth.by_person.float())
        rules = torch.cat([truth.by_turn, truth.by_expression]).float()
        at_rest = offset + torch.einsum("nh,hlc->nlc", habits, rules)
        across = torch.einsum("nxc,nlc->nlx", R_seen[:, :2], at_rest)
        people.append(Sightings(R_seen[:, :2], across, habits))
    return people


def test_the_response_is_found_from_sightings():
    truth = _some_response(4)
    found = fit_response(_people(truth, 60), components=3)
    assert (found.by_turn - truth.by_turn).norm() < 0.3 * truth.by_turn.norm()
    assert (found.by_expression - truth.by_expression).norm() < 0.4 * truth.by_expression.norm()
    basis, _ = torch.linalg.qr(truth.by_person.flatten(1).T)
    left = found.by_person.flatten(1).T - basis @ (basis.T @ found.by_person.flatten(1).T)
    assert left.norm() < 0.2 * found.by_person.norm(), "the same components, in some mixture"
    assert found.rest_sigma < 0.0004


def test_too_few_people_are_an_error():
    with pytest.raises(UserError, match="draw more"):
        fit_response(_people(_some_response(2), 4))


def test_derivatives_by_the_person_match_finite_differences():
    model = make_small_face_model()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout, _some_response(len(model.expression_names)))
    camera, row = batch_of((still_camera(),) * 2), torch.arange(2)
    state = 0.1 * torch.rand(2, layout.size, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    state[:, 5] -= 0.8
    subject = unknown_subject(reduced)
    analytic = reduced.linearize(state, subject.identity, subject.bias, camera, row, with_identity=True).by_person
    assert analytic is not None
    for component in range(3):
        step = torch.zeros(len(subject.shared), dtype=torch.float64)
        step[len(subject.identity) + component] = 1e-4
        there, back = move_subject(subject, step, reduced.response), move_subject(subject, -step, reduced.response)
        numeric = [reduced.project(state, s.identity, s.bias, camera, row) for s in (there, back)]
        torch.testing.assert_close(analytic[..., component], (numeric[0] - numeric[1]) / 2e-4, atol=1e-4, rtol=1e-5)


def _fitted_identity(detects: DetectorResponse, expects: DetectorResponse) -> float:
    """Return the error of the identity that is fitted to a detector's landmarks of a person."""
    model = make_small_face_model()
    layout = layout_of(model)
    truth, reduced = reduce_face_model(model, layout, detects), reduce_face_model(model, layout, expects)
    state = torch.zeros(8, layout.size, dtype=torch.float64)
    state[:, :2] = 0.3 * torch.randn(8, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    state[:, 5] = -0.8
    identity = torch.linspace(-1, 1, 6, dtype=torch.float64)
    person = unknown_subject(truth)
    step = torch.cat([identity, torch.linspace(-1.5, 1.5, len(person.person), dtype=torch.float64)])
    person = move_subject(person, step, detects)
    cameras: CameraBatch = batch_of((still_camera(),))
    detected = truth.project(
        state, person.identity, person.bias, cameras[torch.zeros(8, dtype=torch.long)], torch.arange(8)
    )
    views = Views(detected, torch.arange(8), torch.zeros(8, dtype=torch.long), torch.ones(8, dtype=torch.float64))
    settings = TrackingSettings(identity_weight=1.0)
    own = SequenceFit(cameras, state)
    term = all_landmarks(reduced, views, own, settings)
    fitted = fit_shared([term], Fit(unknown_subject(reduced), (own,)), [None], settings)
    return float((fitted.subject.identity - identity).norm())


def test_who_expects_the_detectors_habits_finds_the_person():
    model = make_small_face_model()
    habits = _some_response(len(model.expression_names))
    habits = replace(habits, mean=3 * habits.mean, by_person=3 * habits.by_person)
    knowing = _fitted_identity(habits, habits)
    ignorant = _fitted_identity(habits, unknown_response(_POINTS, len(model.expression_names), 0.003))
    assert knowing < 0.5 * ignorant, (knowing, ignorant)


def test_several_cameras_expect_nothing_of_turns():
    response = _some_response(2).without_turns()
    turned = torch.tensor([[0.3, 0.2, 0.0]], dtype=torch.float64)
    assert not response.of_turns(turned).any()
    assert response.mean.any()
    far = _some_response(2).of_turns(torch.full((1, 3), math.pi, dtype=torch.float64))
    near = _some_response(2).of_turns(torch.full((1, 3), 0.6, dtype=torch.float64))
    np.testing.assert_array_equal(far.numpy(), near.numpy())
