"""The parts of tracking are right: derivatives, costs and equations, solvers, weights, gaps, habits of turns."""

from dataclasses import replace

import pytest
import torch

from mien.tracking import SmoothnessSettings, TrackingSettings
from mien.tracking.fitting import (
    Bounds,
    Fit,
    NormalEquations,
    SequenceFit,
    Smoothness,
    Subject,
    batch_of,
    layout_of,
    minimize_frames,
    shot_of,
    smoothness_of,
    solve_chain,
)
from mien.tracking.landmarks import LandmarkTerm, all_landmarks, groups, reduce_face_model, without_turn_habits
from mien.tracking.landmarks.outcome import fill_gaps
from mien.tracking.landmarks.shared_fit import joint_cost, precision_of_shared
from mien.tracking.landmarks.term import unknown_subject
from small_face_model import make_small_face_model
from tracking_case import make_tracking_case, still_camera


def _model_with_correctives():
    model = make_small_face_model()
    free = len(model.free_joint_names)
    random = torch.Generator().manual_seed(3)
    return replace(model, pose_basis=0.01 * torch.randn(9 * free, *model.template.shape, generator=random))


def _random_state(layout, count: int = 3) -> torch.Tensor:
    random = torch.Generator().manual_seed(4)
    state = 0.3 * torch.rand(count, layout.size, generator=random, dtype=torch.float64)
    state[:, 5] -= 0.8
    return state


def test_reduced_model_is_the_model():
    model = _model_with_correctives()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout)
    state, identity = _random_state(layout), torch.linspace(-1, 1, 6, dtype=torch.float64)
    camera = still_camera()
    full = reduced.face_model
    vertices = full(layout.face_params(state, identity))
    expected = camera.project(full.landmark_positions(vertices, "mediapipe"))[0]
    bias = torch.zeros(478, 3, dtype=torch.float64)
    projected = reduced.project(state, identity, bias, batch_of((camera,) * 3), torch.arange(3))
    torch.testing.assert_close(projected, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("which", ["state", "identity", "bias", "focal"])
def test_derivatives_match_finite_differences(which):
    model = _model_with_correctives()
    layout = layout_of(model)
    reduced = reduce_face_model(model, layout)
    camera, row = still_camera(), torch.tensor([0, 2, 1, 2])  # one timestep was seen by two cameras
    at = {"state": _random_state(layout), "identity": torch.linspace(-1, 1, 6, dtype=torch.float64),
          "bias": torch.zeros(478, 3, dtype=torch.float64), "focal": torch.zeros(1, dtype=torch.float64)}  # fmt: skip

    def project(**changed):
        values = {**at, **changed}
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= values["focal"].exp()
        return reduced.project(
            values["state"], values["identity"], values["bias"], batch_of((replace(camera, K=K),) * 4), row
        )

    linear = reduced.linearize(
        at["state"], at["identity"], at["bias"], batch_of((camera,) * 4), row, with_identity=True
    )
    analytic = {"state": linear.by_frame, "identity": linear.by_identity, "bias": linear.by_bias,
                "focal": linear.by_log_focal[..., None]}[which]  # fmt: skip
    step = 1e-6
    shifts = step * torch.eye(at[which].shape[-1], dtype=torch.float64)
    numeric = [(project(**{which: at[which] + s}) - project(**{which: at[which] - s})) / (2 * step) for s in shifts]
    torch.testing.assert_close(analytic, torch.stack(numeric, dim=-1), atol=1e-5, rtol=1e-6)


def test_free_parameters():
    """Pinned expressions, the neck and the roll of eyes are not free, and eyes that diverge cost more."""
    layout = layout_of(make_small_face_model())
    assert layout.names[6:13] == tuple(f"move{index}" for index in range(7)), "the last expression is pinned"
    assert layout.names[13:] == ("left_eye_x", "left_eye_y", "right_eye_x", "right_eye_y"), "no neck, no roll of eyes"
    assert torch.linalg.eigvalsh(layout.precision[6:, 6:]).min() > 0
    # Eyes that look alike cost less than eyes that look apart.
    alike, apart = torch.zeros(2, layout.size, dtype=torch.float64)
    alike[[14, 16]], apart[14], apart[16] = 0.1, 0.1, -0.1
    assert alike @ layout.precision @ alike < apart @ layout.precision @ apart


def test_bounded_least_squares():
    # |x - target|^2 in a box: the solution is the clipped target; in a tilted metric, the bound is still kept.
    target = torch.tensor([[2.0, 0.5], [-1.0, 0.2]], dtype=torch.float64)
    metric = torch.tensor([[2.0, 0.9], [0.9, 1.0]], dtype=torch.float64)

    def cost(state):
        return ((state - target) @ metric * (state - target)).sum(1)

    def equations(state):
        return NormalEquations(cost(state), (state - target) @ metric, metric.expand(2, 2, 2))

    box = Bounds(torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    found = minimize_frames(equations, cost, torch.full((2, 2), 0.5, dtype=torch.float64), box, 30)
    assert found[0, 0] == 1
    assert found[1, 0] == 0
    # With x clamped, y minimises on: y = target_y - (0.9 / 1.0) (x - target_x), clamped as well.
    torch.testing.assert_close(found[0, 1], torch.tensor(1.0, dtype=torch.float64))
    torch.testing.assert_close(found[1, 1], torch.tensor(0.0, dtype=torch.float64))


@pytest.mark.parametrize("timesteps", [3, 9])
def test_chain_solver_matches_the_dense_solution(timesteps):
    random = torch.Generator().manual_seed(timesteps)
    p = 3
    root = torch.randn(timesteps, p, p, generator=random, dtype=torch.float64)
    hessian = root @ root.mT + torch.eye(p, dtype=torch.float64)
    gradient = torch.randn(timesteps, p, generator=random, dtype=torch.float64)
    state = torch.randn(timesteps, p, generator=random, dtype=torch.float64)
    linked = torch.ones(timesteps, dtype=torch.bool)
    linked[[0, -1]] = False
    smoothness = Smoothness(torch.tensor([0.0, 1.0, 30.0], dtype=torch.float64), linked)
    held = torch.zeros(timesteps, p, dtype=torch.bool)
    held[1, 2] = True
    step = solve_chain(NormalEquations(gradient[:, 0], gradient, hessian), smoothness, state, held)

    weights = smoothness.weights(state)
    second = torch.zeros(timesteps, timesteps, dtype=torch.float64)
    for t in range(1, timesteps - 1):
        second[t, t - 1 : t + 2] = torch.tensor([1.0, -2.0, 1.0])
    dense = torch.block_diag(*hessian)
    for column in range(p):
        dense[column::p, column::p] += second.T @ torch.diag(weights[:, column]) @ second
    moving = ~held.flatten()
    expected = torch.zeros(timesteps * p, dtype=torch.float64)
    full_gradient = (gradient + smoothness.gradient(state)).flatten()
    expected[moving] = -torch.linalg.solve(dense[moving][:, moving], full_gradient[moving])
    torch.testing.assert_close(step.flatten(), expected)


def test_smoothness_gradient_is_that_of_its_cost():
    state = torch.randn(7, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    linked = torch.tensor([False, True, True, False, True, True, False])
    smoothness = Smoothness(torch.tensor([1.0, 50.0], dtype=torch.float64), linked)
    smoothness.cost(state).backward()
    torch.testing.assert_close(2 * smoothness.gradient(state.detach()), state.grad)


def test_missing_frames_cut_the_chain():
    valid = torch.tensor([True, True, True, False, True, True, True, True])
    smoothness = smoothness_of(layout_of(make_small_face_model()), valid, 25.0, SmoothnessSettings())
    assert smoothness.linked.tolist() == [False, True, False, False, True, True, False]


def test_eyelids_are_not_smoothed():
    model = make_small_face_model()
    names = ("eyeBlinkLeft", *model.expression_names[1:])
    layout = layout_of(replace(model, expression_names=names))
    precision = smoothness_of(layout, torch.ones(5, dtype=torch.bool), 25.0, SmoothnessSettings()).precision
    assert precision[6] == 0
    assert precision[7] > 0
    assert (precision[layout.joint_columns] == 0).all(), "eyes jump"


def test_gaps_at_the_ends_repeat_the_nearest():
    face = make_small_face_model().neutral(2)
    face = replace(face, head_translation=torch.tensor([[0.0, 0, -1], [1.0, 0, -1]]))
    valid = torch.tensor([False, True, False, False, True, False])
    filled = fill_gaps(face, valid)
    torch.testing.assert_close(filled.head_translation[:, 0], torch.tensor([0, 0, 1 / 3, 2 / 3, 1, 1]))


def test_landmark_groups_are_mediapipes():
    connections = pytest.importorskip("mediapipe.python.solutions.face_mesh_connections")

    def points(name: str) -> set[int]:
        return {index for edge in getattr(connections, name) for index in edge}

    assert set(groups.OVAL) == points("FACEMESH_FACE_OVAL")
    assert set(groups.LIPS) == points("FACEMESH_LIPS")
    assert set(groups.LEFT_EYELIDS) == points("FACEMESH_LEFT_EYE")
    assert set(groups.RIGHT_EYELIDS) == points("FACEMESH_RIGHT_EYE")
    assert set(groups.BROWS) == points("FACEMESH_LEFT_EYEBROW") | points("FACEMESH_RIGHT_EYEBROW")
    assert set(groups.NOSE) == points("FACEMESH_NOSE")
    assert set(groups.LEFT_IRIS[1:]) == points("FACEMESH_LEFT_IRIS")
    assert set(groups.RIGHT_IRIS[1:]) == points("FACEMESH_RIGHT_IRIS")
    assert groups.landmark_weights().mean() == pytest.approx(1)


# Costs and their equations --------------------------------------------------------------------------------------------

STEP = 1e-5


@pytest.fixture(scope="module")
def case() -> tuple[LandmarkTerm, SequenceFit, Subject]:
    """Return a term over five timesteps, away from its minimum and from its prior's."""
    made = make_tracking_case(timesteps=5)
    shot = shot_of(made.capture, TrackingSettings())
    reduced = reduce_face_model(made.model, layout_of(made.model))
    state = 0.05 * torch.randn(5, reduced.layout.size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    state[:, 5] -= 0.9
    state[:, 6:] = state[:, 6:].abs() + 0.1
    own = SequenceFit(shot.cameras, state)
    return all_landmarks(reduced, shot.views, own, TrackingSettings()), own, unknown_subject(reduced)


def half_slope(cost, at: torch.Tensor, direction: torch.Tensor) -> float:
    """Return half the derivative of a cost in a direction, by central differences."""
    return float(cost(at + STEP * direction).sum() - cost(at - STEP * direction).sum()) / (4 * STEP)


def test_priors_weigh_as_much_in_the_cost_as_in_the_equations(case):
    """Half of the prior would show: the slope may differ by a ten-thousandth of its pull."""
    term, own, subject = case
    equations = term.equations(own.state, subject, own.cameras)
    torch.testing.assert_close(equations.cost, term.cost(own.state, subject, own.cameras))
    pull = own.state @ term.model.layout.precision
    for column in range(6, own.state.shape[1]):
        direction = torch.zeros_like(own.state)
        direction[2, column] = 1
        found = half_slope(lambda state: term.cost(state, subject, own.cameras), own.state, direction)
        # Landmarks are linearised, so their slope is exact, and the prior is quadratic.
        assert found == pytest.approx(
            float(equations.gradient[2, column]), rel=1e-4, abs=1e-4 * float(pull.abs().max())
        )


def test_the_prior_alone_is_quadratic_with_the_layout_s_precision(case):
    term, own, subject = case
    blind = term.at(torch.arange(5))
    blind = type(term)(blind.model, blind.views, torch.zeros_like(blind.weights), blind.sigma, blind.outlier)
    precision = term.model.layout.precision
    wanted = ((own.state @ precision) * own.state).sum(-1)
    assert float(wanted.min()) > 0.1
    torch.testing.assert_close(blind.cost(own.state, subject, own.cameras), wanted)
    equations = blind.equations(own.state, subject, own.cameras)
    torch.testing.assert_close(equations.cost, wanted)
    torch.testing.assert_close(equations.gradient, own.state @ precision)
    torch.testing.assert_close(equations.hessian, precision.expand_as(equations.hessian))


def test_shared_parameters_have_one_prior_in_the_cost_and_in_the_equations(case):
    term, own, subject = case
    settings = TrackingSettings()
    fit = Fit(subject, (own,))
    precision = precision_of_shared(fit, [0], settings)
    values = torch.linspace(0.3, 0.9, len(precision), dtype=torch.float64)
    landmarks = float(term.cost(own.state, subject, own.cameras).sum())
    total = float(joint_cost([term], fit, precision, values))
    assert total - landmarks == pytest.approx(float((precision * values**2).sum()), rel=1e-9)
    _, shared = term.joint_equations(own.state, subject, own.cameras)
    with_prior = shared.with_prior(precision, values)
    torch.testing.assert_close(with_prior.gradient - shared.gradient, precision * values)
    torch.testing.assert_close((with_prior.hessian - shared.hessian).diagonal(), precision)


# Expressions that nod with the head -----------------------------------------------------------------------------------

PLAIN, FAINT = 6, 7
"""Columns of an expression that moves landmarks by centimetres, and of one that moves them by tenths of millimetres."""


@pytest.fixture(scope="module")
def term() -> LandmarkTerm:
    case = make_tracking_case(timesteps=60)
    shares = torch.ones(len(case.model.expression_basis), 1, 1, dtype=torch.float64)
    shares[0], shares[FAINT - PLAIN] = 3, 0.01
    model = replace(case.model, expression_basis=shares * case.model.expression_basis)
    shot = shot_of(case.capture, TrackingSettings())
    reduced = reduce_face_model(model, layout_of(model))
    state = torch.zeros(60, reduced.layout.size, dtype=torch.float64)
    state[:, 5] -= 0.9
    return all_landmarks(reduced, shot.views, SequenceFit(shot.cameras, state), TrackingSettings())


def _nodding(term: LandmarkTerm, turn: float) -> SequenceFit:
    """Return a fit in which both expressions follow pitch, beside motion of their own."""
    time = torch.arange(60, dtype=torch.float64)
    state = torch.zeros(60, term.model.layout.size, dtype=torch.float64)
    state[:, 5] -= 0.9
    state[:, 0] = turn * (0.4 * time).sin()
    for column in (PLAIN, FAINT):
        state[:, column] = 0.5 + 0.2 * (0.4 * time).sin() + 0.1 * (1.3 * time).sin()
    return SequenceFit(batch_of((still_camera(),)), state)


def _following(state: torch.Tensor) -> torch.Tensor:
    """Return the correlation of each column with pitch."""
    turned = (state - state.mean(0)) / (state - state.mean(0)).norm(dim=0).clamp_min(1e-12)
    return turned[:, 0] @ turned


def test_only_what_the_face_hardly_shows_stops_nodding(term):
    own = _nodding(term, 0.2)
    found = without_turn_habits(term, unknown_subject(term.model), own)
    before, after = _following(own.state), _following(found.state)
    assert before[PLAIN] > 0.85
    assert before[FAINT] > 0.85
    assert after[PLAIN] > 0.85
    assert after[FAINT] < 0.3
    torch.testing.assert_close(found.state[:, PLAIN], own.state[:, PLAIN], atol=0.03, rtol=0)
    # Motion that does not follow pitch is unchanged.
    turn = own.state[:, :1] - own.state[:, :1].mean()
    change = found.state[:, FAINT : FAINT + 1] - own.state[:, FAINT : FAINT + 1]
    torch.testing.assert_close(change, turn * (turn.T @ change) / (turn.T @ turn), atol=1e-9, rtol=0)
    stop = term.model.layout.expression_columns.stop
    others = [column for column in range(own.state.shape[1]) if not PLAIN <= column < stop]
    torch.testing.assert_close(found.state[:, others], own.state[:, others], atol=0, rtol=0)


def test_a_head_that_does_not_turn_keeps_its_expressions(term):
    own = _nodding(term, 0.0)
    found = without_turn_habits(term, unknown_subject(term.model), own)
    torch.testing.assert_close(found.state, own.state, atol=0, rtol=0)
