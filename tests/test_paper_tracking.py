"""The `paper` schedule is better than landmarks alone, and the same in every run; its terms and optimiser are right."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from mien.adam import Moments
from mien.tracking import track, track_subject
from mien.tracking.descent import epochs, terms
from mien.tracking.descent import fit as frames
from mien.tracking.descent.epochs import Descent, apply_adam
from mien.tracking.descent.scene import first_state, paper_scene
from mien.tracking.descent.terms import landmark_terms, prior_term, read_target
from mien.tracking.fitting import resume
from mien.tracking.fitting.fit import Fit, SequenceFit, widen
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.sequence import sequence_data
from mien.tracking.landmarks.groups import LEFT_IRIS, RIGHT_IRIS, landmark_weights
from mien.tracking.landmarks.model import reduce_face_model
from mien.tracking.landmarks.problem import Problem, lenses_of
from mien.tracking.landmarks.term import all_landmarks, quiet_landmarks, unknown_subject
from mien.tracking.settings import PaperSettings, PhotometricSettings, ScoringSettings, TrackingSettings
from photometric_case import FOCAL, PhotometricCase, assert_alike, make_photometric_case
from test_photometric_tracking import turn_error, wobble

PIXELS = PhotometricSettings(texture_size=64, keyframes=4, shared_steps=1)
LANDMARKS = TrackingSettings(focal=FOCAL, schedule="landmarks", photometric=PIXELS)
QUICK = PaperSettings(start="fast", texture_size=64, first_steps=60, steps=15, epochs=3)
PAPER = replace(LANDMARKS, schedule="paper", paper=QUICK)
ALONE = replace(PAPER, paper=replace(QUICK, start="landmarks"))


case = pytest.fixture(scope="module")(lambda: make_photometric_case(timesteps=8))


def scene_of(case: PhotometricCase, settings: TrackingSettings, **response: torch.Tensor):
    """Return the scene at the true pose, with the fit, the shot and the model that it is of."""
    shot, layout = sequence_data(case.capture, settings), layout_of(case.model)
    model = reduce_face_model(case.model, layout)
    model = reduce_face_model(case.model, layout, replace(model.response, **response))
    state = torch.cat([case.face.head_rotation, case.face.head_translation], dim=1).double()
    fit = Fit(unknown_subject(model), (SequenceFit(shot.cameras, widen(state, layout)),))
    problem = Problem(model, [shot], lenses_of([case.capture], settings), settings)
    return paper_scene(problem, fit), fit, shot, model


def _descent(case: PhotometricCase, settings: TrackingSettings) -> Descent:
    """The state before any step."""
    scene, fit, *_ = scene_of(case, settings)
    descent = Descent(scene, first_state(scene, fit))
    descent.state.visibility += 1
    return descent


@pytest.mark.unchecked
def test_pixels_calm_what_landmarks_leave(case):
    longer = replace(ALONE, paper=replace(ALONE.paper, steps=50, epochs=10))  # many steps follow from the frame before
    by_landmarks, by_descent, alone = (track(case.capture, case.model, each) for each in (LANDMARKS, PAPER, longer))
    for found in (by_descent, alone):
        assert wobble(case, found) < 0.25 * wobble(case, by_landmarks)
        assert found.pixel_residuals is not None
        assert found.pixel_residuals.median() < 0.08
    assert turn_error(case, by_descent) < 0.3
    assert turn_error(case, alone) < 0.9 * turn_error(case, by_landmarks)
    assert by_descent.settings["schedule"] == "paper"
    offsets = by_descent.face.vertex_offsets
    assert offsets is not None
    assert offsets.norm(dim=1).max() < 0.005


def test_the_first_frame_has_turns_until_it_no_longer_gets_better(case, monkeypatch):
    descent, costs, given = _descent(case, ALONE), [], iter((100.0, 90.0, 80.0, 79.5, 1.0))

    def turn(*_: object, **__: object) -> float:
        costs.append(next(given))
        return costs[-1]

    monkeypatch.setattr(frames, "turn_of_first", turn)
    frames.fit_first(descent, descent.targets(0, 0), first_of_all=True)
    assert costs == [100.0, 90.0, 80.0, 79.5]


def test_all_parameters_are_fitted_to_the_first_frame(case):
    descent = _descent(case, replace(ALONE, focal=None))
    before = {name: tensor.clone() for name, tensor in descent.state.tensors().items()}
    target = descent.targets(0, 0)
    first, last = (frames.turn_of_first(descent, target, 20, appearance_first=on) for on in (True, False))
    assert last < first
    changed = {name for name, tensor in descent.state.tensors().items() if not tensor.equal(before[name])}
    assert changed == {"identity", "offsets", "texture", "lights", "log_focals", "frames_0"}
    assert descent.state.frames[0][1:].equal(before["frames_0"][1:])


def test_each_next_frame_starts_from_the_one_before(case, monkeypatch):
    descent, begun = _descent(case, ALONE), []
    rows = descent.state.frames[0]

    def fit(_: Descent, targets: list, steps: int) -> None:
        begun.append((steps, targets[0].row, rows[targets[0].row].clone()))
        rows[targets[0].row] += 1e-4

    monkeypatch.setattr(frames, "fit_first", lambda *_, **__: None)
    monkeypatch.setattr(frames, "fit_row", fit)
    monkeypatch.setattr(frames, "visibility_of", lambda scene, *_: scene.used)
    frames.fit_sequence(descent, 0, lambda *_, **__: None, StageCache(None))
    assert [(steps, row) for steps, row, _ in begun] == [(QUICK.steps, row) for row in range(1, len(rows))]
    assert all(start.equal(rows[row - 1]) for _, row, start in begun if (0, row - 1) not in descent.lost)
    assert len(descent.lost) < 2


def test_offsets_are_on_every_vertex_and_their_laplacian_counts(case):
    """One vertex that stands out costs its own distance from the mean of its neighbours, and each neighbour's."""
    model = replace(case.model, region_names=("scalp",), face_regions=torch.zeros(len(case.model.faces)).long())
    shares = [scene_of(replace(case, model=model), settings)[0].offset_share for settings in (ALONE, PAPER)]
    assert [set(share.flatten().tolist()) for share in shares] == [{1.0}, {0.0}]
    scene, offsets = scene_of(case, ALONE)[0], torch.zeros_like(case.model.template)
    assert float(terms.offset_term(scene, offsets)) == 0
    near = [set(case.model.faces[(case.model.faces == v).any(1)].flatten().tolist()) - {v} for v in range(len(offsets))]
    offsets[7] = torch.tensor([0.0, 0.003, 0.004])
    laplacian = 0.005**2 * (1 + sum(1 / len(near[v]) ** 2 for v in near[7]))
    expected = (0.005**2 / 0.002**2 + laplacian / 0.0001**2) / 100
    assert float(terms.offset_term(scene, offsets)) == pytest.approx(expected, rel=1e-4)


def test_the_first_texture_is_from_the_most_frontal_camera(case, monkeypatch):
    """The first camera may see a head from behind."""
    descent, used = _descent(case, ALONE), []
    (target,) = descent.targets(0, 0)
    behind, camera = replace(target, camera=1), descent.scene.camera(0, 0, descent.state.log_focals)
    around = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    around[2, 3] = -1.2  # on the other side of the head, which is 0.6 m away
    away = replace(camera, viewmat=camera.viewmat @ around)
    monkeypatch.setattr(type(descent.scene), "camera", lambda _, __, index, focals: camera if index == 0 else away)
    monkeypatch.setattr(frames, "guess_texture", lambda _, one, *__: used.append(one.camera))
    monkeypatch.setattr(frames, "turn_of_first", lambda *_, **__: 1.0)
    frames.fit_first(descent, [behind, target], first_of_all=True)
    assert used == [0]


def test_every_camera_of_a_timestep_counts_in_every_step(case):
    descent = _descent(case, PAPER)
    (target,) = descent.targets(0, 3)
    dark = replace(target, image=0 * target.image)
    moving, weights = descent.moving(target, ())[0], descent.scene.used
    given = ([target], [dark], [target, dark])
    one, other, both = (float(descent.frame_cost(some, moving, weights, None)) for some in given)
    assert other > one
    assert both == pytest.approx((one + other) / 2, rel=1e-5)


def test_every_step_of_pass_and_epochs_has_all_cameras(case, monkeypatch):
    descent, counts = _descent(case, replace(PAPER, paper=replace(QUICK, first_steps=2, steps=1))), []
    frame_cost = Descent.frame_cost

    def counted(self: Descent, targets: list, *more: Any) -> torch.Tensor:
        counts.append(len(targets))
        return frame_cost(self, targets, *more)

    monkeypatch.setattr(Descent, "cameras", lambda *_: [0, 0])  # one camera, seen twice
    monkeypatch.setattr(Descent, "frame_cost", counted)
    cache = StageCache(None)
    frames.fit_sequence(descent, 0, lambda *_, **__: None, cache)
    in_pass, descent.done = len(counts), descent.frames
    descent.fit_epoch(0, lambda *_, **__: None, cache)
    assert len(counts) == in_pass + descent.frames
    assert in_pass > descent.frames
    assert set(counts) == {2}


def test_smoothness_in_the_frame_pass_is_a_setting(case):
    ends = {}
    for smoothness in (0.0, 1.0):
        descent = _descent(case, replace(PAPER, paper=replace(QUICK, pass_smoothness=smoothness)))
        rows = descent.state.frames[0]
        rows[3] = descent.bounds.clip(rows[3] + 0.02)
        frames.fit_row(descent, descent.targets(0, 3), 50)
        ends[smoothness] = rows[3].clone()
    steady = 2 * rows[2] - rows[1]
    alone, smooth = (float((end - steady)[:3].norm()) for end in ends.values())
    assert smooth < 0.5 * alone


def test_the_schedule_alone_is_the_supplements():
    alone, better = TrackingSettings(schedule="paper"), TrackingSettings(schedule="paper", paper=QUICK)
    assert (alone.paper.start, alone.paper.steps, alone.paper.epochs) == ("landmarks", 50, 30)
    assert alone.paper.pass_smoothness > 0
    each = (alone, better, TrackingSettings())
    found = [(one.landmark_set, ScoringSettings().cut_after(one, torso=False)) for one in each]
    assert found == [("ibug51", "line"), ("mediapipe", "plane"), ("mediapipe", "plane")]
    assert int((landmark_weights(alone.landmark_set) > 0).sum()) == 51 + len(LEFT_IRIS + RIGHT_IRIS)
    given = replace(alone, landmarks="mediapipe"), ScoringSettings("plane")
    assert (given[0].landmark_set, given[1].cut_after(given[0], torso=False)) == ("mediapipe", "plane")


def test_the_neck_has_no_column_of_its_own(case):
    """The head has a pose of its own, so a neck above the shoulders would turn nothing that the fit can see."""
    assert any("neck" in name for name in case.model.joint_names)
    assert not any("neck" in name for name in layout_of(case.model).names)


@pytest.mark.unchecked
def test_the_same_with_any_number_of_threads(monkeypatch):
    case = make_photometric_case(timesteps=5)
    monkeypatch.setattr(epochs, "MOST_BATCHES", 2)
    settings, runs = replace(ALONE, paper=replace(ALONE.paper, first_steps=10, steps=3, epochs=2)), []
    for threads in ("1", "2"):
        monkeypatch.setenv("MIEN_THREADS", threads)
        runs.append(track(case.capture, case.model, settings))
    assert_alike(*runs)


def test_landmarks_cost_what_they_cost_other_schedules(case, monkeypatch):
    """The detector's whole response counts, with turns and expressions."""
    monkeypatch.setattr(terms, "gap_costs", lambda *_: torch.zeros(1))
    settings, random = PAPER, torch.Generator().manual_seed(0)
    plain = scene_of(case, settings)[3].response
    scene, fit, shot, model = scene_of(case, settings, **{
        name: 0.01 * torch.randn(getattr(plain, name).shape, generator=random, dtype=torch.float64)
        for name in ("by_turn", "by_expression")
    })  # fmt: skip
    descent, (own,) = Descent(scene, first_state(scene, fit)), fit.sequences
    target = read_target(scene, 0, 3, 0)
    term = quiet_landmarks(all_landmarks(model, shot.views, own, settings))
    expected = term.cost(own.state, fit.subject, own.cameras)[3]
    found = landmark_terms(scene, target, descent.moving(target, ())[0]) + prior_term(scene, descent.state.frames[0][3])
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=0)


def test_adam_is_that_of_torch():
    random = torch.Generator().manual_seed(0)
    values, moments = torch.randn(5, generator=random), Moments.zeros(torch.zeros(5))
    expected = torch.nn.Parameter(values.clone())
    optimizer = torch.optim.Adam([expected], lr=0.1, eps=1e-12)
    for _ in range(4):
        gradient = torch.randn(5, generator=random)
        expected.grad = gradient.clone()
        optimizer.step()
        apply_adam(moments, values, gradient, 0.1)
    torch.testing.assert_close(values, expected.detach(), atol=1e-6, rtol=0)


@pytest.mark.unchecked
@pytest.mark.parametrize(("start", "stops"), [("landmarks", (3, 4)), ("fast", (2,))])
def test_an_interrupted_fit_goes_on(tmp_path, monkeypatch, start, stops: tuple[int, ...]) -> None:
    case, keep = make_photometric_case(timesteps=5), tmp_path / "kept"
    settings = replace(PAPER, paper=replace(QUICK, start=start, first_steps=10, steps=3, epochs=3))
    expected = track_subject([case.capture], case.model, settings)[0]
    monkeypatch.setattr(resume, "INTERVAL_SECONDS", 0.0)
    offer, left = StageCache.offer, [0]

    def offer_then_stop(self: StageCache, name: str, make: Callable) -> None:
        offer(self, name, make)
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    monkeypatch.setattr(StageCache, "offer", offer_then_stop)
    for left[0] in stops:
        pytest.raises(KeyboardInterrupt, track_subject, [case.capture], case.model, settings, keep)
        assert (keep / "descent.safetensors").is_file()
    found = track_subject([case.capture], case.model, settings, keep)[0]
    assert left == [-1], "two epochs after the pass are done, so one is left"
    assert not keep.exists()
    assert_alike(expected, found)
