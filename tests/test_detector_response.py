"""The model of the landmark detector, landmarks that swing between two answers, and faces seen from the side."""

import math
from dataclasses import replace

import pytest
import torch
from detector_calibration import Sightings, fit_response

from mien.camera import look_at
from mien.face import load_face_model
from mien.rotation import matrix_from_axis_angle
from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.sequence import without_flicker
from mien.tracking.fitting.views import CameraBatch, Views, batch_of
from mien.tracking.landmarks.detector_response import DetectorResponse, read_response, unknown_response, write_response
from mien.tracking.landmarks.model import reduce_face_model
from mien.tracking.landmarks.shared_fit import fit_shared
from mien.tracking.landmarks.term import all_landmarks, move_subject, trust_of, unknown_subject
from mien.tracking.settings import TrackingSettings
from refusals import refuses
from small_face_model import make_small_face_model
from tracking_case import still_camera

_POINTS = 478


def _some_response(expressions: int, people: int = 3, seed: int = 0) -> DetectorResponse:
    random = torch.Generator().manual_seed(seed)

    def offsets(*shape: int) -> torch.Tensor:
        return 0.001 * torch.randn(*shape, _POINTS, 3, generator=random, dtype=torch.float64)

    return DetectorResponse(offsets(), offsets(2), offsets(expressions), offsets(people), 0.0004)


def test_a_file_is_read_as_it_was_written(tmp_path, monkeypatch):
    shipped = read_response(load_face_model("anny"), 0.003)
    assert len(shipped.by_person) == 40
    assert 0.0003 < shipped.mean.norm(dim=1).mean() < 0.003, "some millimetres at most"
    model = make_small_face_model()
    ours, theirs = (_some_response(len(model.expression_names), seed=seed) for seed in (0, 1))
    where = "mien.tracking.landmarks.detector_response.response_path"
    monkeypatch.setattr(where, lambda name, detector="mediapipe": tmp_path / f"{name}_{detector}.npz")
    write_response(tmp_path / f"{model.name}_litert.npz", model, theirs, 5, "litert")
    assert len(read_response(model, 0.003, "litert").by_person) == 0, "nothing is known without mediapipe's file"
    write_response(tmp_path / f"{model.name}_mediapipe.npz", model, ours, 5)
    for read, of_all, of_people in (
        (read_response(model, 0.003), ours, ours), (read_response(model, 0.003, "litert"), theirs, ours)
    ):  # fmt: skip
        for name in ("mean", "by_turn", "by_expression", "by_person"):
            expected = getattr(of_all if name in ("mean", "by_turn") else of_people, name)
            torch.testing.assert_close(getattr(read, name), expected, atol=3e-6, rtol=0)
    assert read_response(model, 0.003).rest_sigma == pytest.approx(ours.rest_sigma)
    other = read_response(replace(model, faces=model.faces.flip(0)), 0.002)
    assert (len(other.by_person), other.rest_sigma) == (0, 0.002), "measured on another mesh"


def _people(truth: DetectorResponse, count: int, pictures: int = 30) -> list[Sightings]:
    random, people = torch.Generator().manual_seed(7), []
    for _ in range(count):
        turns = 0.4 * torch.randn(pictures, 3, generator=random)
        R_seen = matrix_from_axis_angle(turns)
        expression = torch.rand(pictures, len(truth.by_expression), generator=random)
        habits = torch.cat([turns[:, :2], expression], dim=1)
        person = torch.randn(len(truth.by_person), generator=random)
        offset = truth.mean.float() + torch.einsum("k,klc->lc", person, truth.by_person.float())
        rules = torch.cat([truth.by_turn, truth.by_expression]).float()
        at_rest = offset + torch.einsum("nh,hlc->nlc", habits, rules)
        people.append(Sightings(R_seen[:, :2], torch.einsum("nxc,nlc->nlx", R_seen[:, :2], at_rest), habits))
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
    refuses("draw more", fit_response, _people(_some_response(2), 4))


def test_derivatives_by_the_person_match_finite_differences():
    model = make_small_face_model()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout, _some_response(len(model.expression_names)))
    camera, row = batch_of((still_camera(),) * 2), torch.arange(2)
    state = 0.1 * torch.rand(2, layout.size, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    state[:, 5] -= 0.8
    subject = unknown_subject(reduced)
    by_shared = reduced.linearize(state, subject.identity, subject.bias, camera, row, with_identity=True).by_shared
    assert by_shared is not None
    analytic = by_shared[..., len(subject.identity) : -1]
    for component in range(3):
        step = torch.zeros(len(subject.shared), dtype=torch.float64)
        step[len(subject.identity) + component] = 1e-4
        there, back = move_subject(subject, step, reduced.response), move_subject(subject, -step, reduced.response)
        numeric = [reduced.project(state, s.identity, s.bias, camera, row) for s in (there, back)]
        torch.testing.assert_close(analytic[..., component], (numeric[0] - numeric[1]) / 2e-4, atol=1e-4, rtol=1e-5)


def _fitted_identity(detects: DetectorResponse, expects: DetectorResponse) -> float:
    """Return the error of the identity that is fitted to a detector's landmarks of a person."""
    model = make_small_face_model()
    layout, rows, settings = layout_of(model), torch.arange(8), TrackingSettings(identity_weight=1.0)
    truth, reduced = reduce_face_model(model, layout, detects), reduce_face_model(model, layout, expects)
    state = torch.zeros(8, layout.size, dtype=torch.float64)
    state[:, :2] = 0.3 * torch.randn(8, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    state[:, 5] = -0.8
    identity, person = torch.linspace(-1, 1, 6, dtype=torch.float64), unknown_subject(truth)
    step = torch.cat([identity, torch.linspace(-1.5, 1.5, len(person.person), dtype=torch.float64)])
    person, cameras = move_subject(person, step, detects), batch_of((still_camera(),))
    detected = truth.project(state, person.identity, person.bias, cameras[0 * rows], rows)
    views = Views(detected, rows, 0 * rows, torch.ones(8, dtype=torch.float64))
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
    response = _some_response(2)
    assert not response.without_turns().of_turns(torch.tensor([[0.3, 0.2, 0.0]], dtype=torch.float64)).any()
    assert response.without_turns().mean.any()
    far, near = (response.of_turns(torch.full((1, 3), turn, dtype=torch.float64)) for turn in (math.pi, 0.6))
    assert torch.equal(far, near)


HEAD = torch.tensor([0.0, 0.0, -0.9], dtype=torch.float64)


def cameras_at(*angles: float) -> CameraBatch:
    """Return cameras around the head, at angles in radians to the subject's left of straight ahead."""
    turned = torch.tensor(angles, dtype=torch.float64)
    places = HEAD + 0.9 * torch.stack([turned.sin(), 0 * turned, turned.cos()], dim=1)
    looks = torch.stack([look_at(place, HEAD, HEAD.new_tensor([0.0, 1.0, 0.0])) for place in places])
    return CameraBatch(still_camera().K.expand(len(angles), 3, 3), looks)


def views_of(*pictures: tuple[int, int]) -> Views:
    """Return views of these pairs of a timestep and a camera."""
    row, camera = torch.tensor(pictures).unbind(1)
    nothing = torch.zeros(len(row), 1, 2, dtype=torch.float64)
    return Views(nothing, row, camera, torch.ones(len(row), dtype=torch.float64))


def heads_turned(*angles: float) -> torch.Tensor:
    state = torch.zeros(len(angles), 6, dtype=torch.float64)
    state[:, 1] = torch.tensor(angles, dtype=torch.float64)
    state[:, 3:6] = HEAD
    return state


def test_side_views_count_little_and_trust_goes_with_the_head():
    trust = trust_of(views_of((0, 0), (0, 1), (0, 2)), heads_turned(0.0), cameras_at(0.0, 0.3, -1.2))
    torch.testing.assert_close(trust[:2], torch.tensor([1.0, 0.5]).double(), atol=1e-6, rtol=0)
    assert trust[2] < 0.02
    trust = trust_of(views_of((0, 0), (0, 1), (1, 0), (1, 1)), heads_turned(0.0, 1.0), cameras_at(0.0, 1.0))
    assert trust[0] == trust[3] == 1
    assert trust[1:3].max() < 0.05
    # The best picture of a timestep counts whole, even from the side; otherwise priors would decide.
    trust = trust_of(views_of((0, 0), (1, 1), (2, 0), (2, 1)), heads_turned(0.0, 0.0, 0.0), cameras_at(1.2, -1.5))
    assert trust[:3].eq(1).all()
    assert 0.2 < trust[3] < 0.6


def _still(timesteps: int = 20, noise: float = 0.0) -> torch.Tensor:
    random = torch.Generator().manual_seed(5)
    face = 100 * torch.rand(1, 1, 478, 2, generator=random, dtype=torch.float64)
    return face + noise * torch.randn(timesteps, 1, 478, 2, generator=random, dtype=torch.float64)


def _all_seen(marks: torch.Tensor) -> torch.Tensor:
    return torch.ones(marks.shape[:2], dtype=torch.bool)


def _swinging(marks: torch.Tensor, frames: slice) -> torch.Tensor:
    sign = (-1.0) ** torch.arange(len(marks), dtype=torch.float64)
    found = marks.clone()
    found[frames] += sign[frames, None, None, None] * torch.tensor([0.3, 0.8], dtype=torch.float64)
    return found


def test_swings_go_and_noise_motion_blinks_and_short_runs_stay():
    marks = _still(noise=0.05)
    found = without_flicker(_swinging(marks, slice(6, 15)), _all_seen(marks))
    torch.testing.assert_close(found[6:15], marks[6:15], atol=0.35, rtol=0)
    assert (found[8:13] - marks[8:13]).abs().mean() < 0.06
    kept = [*range(5), *range(16, 20)]
    torch.testing.assert_close(found[kept], marks[kept], atol=0, rtol=0)
    marks = _still(8)
    found = without_flicker(_swinging(marks, slice(0, 8)), _all_seen(marks))
    torch.testing.assert_close(found, marks, atol=1e-9, rtol=0)
    marks = _still(40, noise=0.25)
    marks[10:14, :, :50] += 6.0
    marks[20, :, :50] -= 6.0  # of a single frame
    marks[25:] += torch.linspace(0, 40, 15, dtype=torch.float64)[:, None, None, None]
    torch.testing.assert_close(without_flicker(marks, _all_seen(marks)), marks, atol=0, rtol=0)
    marks, seen = _swinging(_still(12), slice(0, 12)), torch.ones(12, 1, dtype=torch.bool)
    marks[[2, 5, 8]], seen[[2, 5, 8]] = torch.nan, False  # frames without a face part runs
    torch.testing.assert_close(without_flicker(marks, seen), marks, atol=0, rtol=0, equal_nan=True)
    marks = _swinging(_still(4), slice(0, 4))
    assert without_flicker(marks, _all_seen(marks)) is marks
