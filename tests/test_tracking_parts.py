"""The parts of tracking are right: derivatives, costs and equations, solvers, weights, gaps, habits of turns."""

from dataclasses import replace

import pytest
import torch

from mien.tracking.fitting import solver
from mien.tracking.fitting.fit import Fit, SequenceFit, Subject, smoothness_of
from mien.tracking.fitting.parameters import layout_of
from mien.tracking.fitting.sequence import sequence_data
from mien.tracking.fitting.views import batch_of
from mien.tracking.landmarks import groups
from mien.tracking.landmarks.model import reduce_face_model
from mien.tracking.landmarks.outcome import fill_gaps, without_turn_habits
from mien.tracking.landmarks.shared_fit import joint_cost, precision_of_shared
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks, unknown_subject
from mien.tracking.settings import SmoothnessSettings, TrackingSettings
from small_face_model import make_small_face_model
from tracking_case import make_tracking_case, still_camera


@pytest.mark.parametrize("which", ["state", "identity", "bias", "focal"])
def test_derivatives_match_finite_differences(which):
    model, random = make_small_face_model(), torch.Generator().manual_seed(3)
    shape = 9 * len(model.free_joint_names), *model.template.shape
    model = replace(model, pose_basis=0.01 * torch.randn(shape, generator=random))
    layout, camera = layout_of(model), still_camera()
    row = torch.tensor([0, 2, 1, 2])  # two cameras saw a timestep
    reduced = reduce_face_model(model, layout)
    state = 0.3 * torch.rand(3, layout.size, generator=random, dtype=torch.float64)
    state[:, 5] -= 0.8
    at = {"state": state, "identity": torch.linspace(-1, 1, 6, dtype=torch.float64),
          "bias": torch.zeros(478, 3, dtype=torch.float64), "focal": torch.zeros(1, dtype=torch.float64)}  # fmt: skip

    def project(**changed: torch.Tensor) -> torch.Tensor:
        state, identity, bias, focal = {**at, **changed}.values()
        K = camera.K.clone()
        K[[0, 1], [0, 1]] *= focal.exp()
        return reduced.project(state, identity, bias, batch_of((replace(camera, K=K),) * 4), row)

    full = reduced.face_model
    marks = full.landmark_positions(full(layout.face_params(state, at["identity"])), "mediapipe")
    torch.testing.assert_close(project(), camera.project(marks)[0][row], atol=1e-4, rtol=0)
    cameras = batch_of((camera,) * 4)
    linear = reduced.linearize(state, at["identity"], at["bias"], cameras, row, with_identity=True)
    assert linear.by_shared is not None
    analytic = {"state": linear.by_frame, "identity": linear.by_shared[..., :-1], "bias": linear.by_bias,
                "focal": linear.by_shared[..., -1:]}[which]  # fmt: skip
    step = 1e-6
    shifts = step * torch.eye(at[which].shape[-1], dtype=torch.float64)
    numeric = [(project(**{which: at[which] + s}) - project(**{which: at[which] - s})) / (2 * step) for s in shifts]
    torch.testing.assert_close(analytic, torch.stack(numeric, dim=-1), atol=1e-5, rtol=1e-6)


def test_free_parameters():
    model = make_small_face_model()
    layout = layout_of(model)
    assert layout.names[6:] == (
        *(f"move{index}" for index in range(7)), "left_eye_x", "left_eye_y", "right_eye_x", "right_eye_y"
    )  # fmt: skip
    assert torch.linalg.eigvalsh(layout.precision[6:, 6:]).min() > 0
    # Eyes that look alike cost less than eyes that look apart.
    alike, apart = torch.zeros(2, layout.size, dtype=torch.float64)
    alike[[14, 16]], apart[14], apart[16] = 0.1, 0.1, -0.1
    assert alike @ layout.precision @ alike < apart @ layout.precision @ apart
    # Eyelids and eyes jump, and missing frames cut the chain.
    layout = layout_of(replace(model, expression_names=("eyeBlinkLeft", *model.expression_names[1:])))
    valid = torch.tensor([True, True, True, False, True, True, True, True])
    smoothness = smoothness_of(layout, valid, 25.0, SmoothnessSettings())
    assert smoothness.linked.tolist() == [False, True, False, False, True, True, False]
    assert smoothness.precision[6] == 0 < smoothness.precision[7]
    # An acceleration counts alike at any rate: its second difference is a quarter at twice the rate.
    faster = smoothness_of(layout, valid, 50.0, SmoothnessSettings()).precision
    torch.testing.assert_close(faster, 16 * smoothness.precision)
    assert (smoothness.precision[layout.joint_columns] == 0).all()
    # Gaps at the ends repeat the nearest.
    face = replace(model.neutral(2), head_translation=torch.tensor([[0.0, 0, -1], [1.0, 0, -1]]))
    filled = fill_gaps(face, torch.tensor([False, True, False, False, True, False]))
    torch.testing.assert_close(filled.head_translation[:, 0], torch.tensor([0, 0, 1 / 3, 2 / 3, 1, 1]))


def test_bounded_least_squares():
    # |x - target|^2 in a box: the solution is the clipped target; in a tilted metric, the bound is still kept.
    target = torch.tensor([[2.0, 0.5], [-1.0, 0.2]], dtype=torch.float64)
    metric = torch.tensor([[2.0, 0.9], [0.9, 1.0]], dtype=torch.float64)

    def cost(state):
        return ((state - target) @ metric * (state - target)).sum(1)

    def equations(state):
        return solver.NormalEquations(cost(state), (state - target) @ metric, metric.expand(2, 2, 2))

    box = solver.Bounds(torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    found = solver.minimize_frames(equations, cost, torch.full((2, 2), 0.5, dtype=torch.float64), box, 30)
    assert found[:, 0].tolist() == [1, 0]
    # With x clamped, y minimises on: y = target_y - (0.9 / 1.0) (x - target_x), clamped as well.
    torch.testing.assert_close(found, torch.tensor([[1.0, 1.0], [0.0, 0.0]], dtype=torch.float64))


@pytest.mark.parametrize("timesteps", [3, 9])
def test_chain_solver_matches_the_dense_solution(timesteps):
    random, p = torch.Generator().manual_seed(timesteps), 3
    root = torch.randn(timesteps, p, p, generator=random, dtype=torch.float64)
    hessian = root @ root.mT + torch.eye(p, dtype=torch.float64)
    gradient, state = torch.randn(2, timesteps, p, generator=random, dtype=torch.float64)
    linked = torch.ones(timesteps, dtype=torch.bool)
    linked[[0, -1]] = False
    smoothness = solver.Smoothness(torch.tensor([0.0, 1.0, 30.0], dtype=torch.float64), linked)
    held = torch.zeros(timesteps, p, dtype=torch.bool)
    held[1, 2] = True
    step = solver.solve_chain(solver.NormalEquations(gradient[:, 0], gradient, hessian), smoothness, state, held)
    weights, second = smoothness.weights(state), torch.zeros(timesteps, timesteps, dtype=torch.float64)
    for t in range(1, timesteps - 1):
        second[t, t - 1 : t + 2] = torch.tensor([1.0, -2.0, 1.0])
    dense = torch.block_diag(*hessian)
    for column in range(p):
        dense[column::p, column::p] += second.T @ torch.diag(weights[:, column]) @ second
    moving, expected = ~held.flatten(), torch.zeros(timesteps * p, dtype=torch.float64)
    full_gradient = (gradient + smoothness.gradient(state)).flatten()
    expected[moving] = -torch.linalg.solve(dense[moving][:, moving], full_gradient[moving])
    torch.testing.assert_close(step.flatten(), expected)
    state.requires_grad_()
    smoothness.cost(state).backward()
    torch.testing.assert_close(2 * smoothness.gradient(state.detach()), state.grad)


def test_frames_and_what_they_share_are_solved_as_one_dense_system():
    random, damping = torch.Generator().manual_seed(0), 0.1
    root = torch.randn(8, 8, generator=random, dtype=torch.float64)  # two frames of three parameters, and two shared
    dense, gradient = root @ root.T + torch.eye(8), torch.randn(8, generator=random, dtype=torch.float64)
    dense[:3, 3:6] = dense[3:6, :3] = 0
    own = torch.stack([dense[:3, :3], dense[3:6, 3:6]])
    frames = solver.NormalEquations(torch.zeros(2), gradient[:6].reshape(2, 3), own)
    shared = solver.SharedEquations(dense[:6, 6:].reshape(2, 3, 2), dense[6:, 6:], gradient[6:])
    held = torch.tensor([[False, False, True], [False, False, False]])
    steps = solver.solve_arrow(frames, shared, held, damping)
    moving, expected = torch.cat([~held.flatten(), torch.ones(2, dtype=torch.bool)]), torch.zeros(8).double()
    damped = dense + torch.diag(damping * dense.diagonal())
    expected[moving] = -torch.linalg.solve(damped[moving][:, moving], gradient[moving])
    torch.testing.assert_close(torch.cat([step.flatten() for step in steps]), expected)


def test_landmark_groups_are_mediapipes():
    connections = pytest.importorskip("mediapipe.python.solutions.face_mesh_connections")
    for group, names in (
        (groups.OVAL, ("FACE_OVAL",)), (groups.LIPS, ("LIPS",)), (groups.NOSE, ("NOSE",)),
        (groups.LEFT_EYELIDS, ("LEFT_EYE",)), (groups.RIGHT_EYELIDS, ("RIGHT_EYE",)),
        (groups.BROWS, ("LEFT_EYEBROW", "RIGHT_EYEBROW")), (groups.LEFT_IRIS[1:], ("LEFT_IRIS",)),
        (groups.RIGHT_IRIS[1:], ("RIGHT_IRIS",)),
    ):  # fmt: skip
        edges = [edge for name in names for edge in getattr(connections, f"FACEMESH_{name}")]
        assert set(group) == {point for edge in edges for point in edge}, names
    assert groups.landmark_weights().mean() == pytest.approx(1)


@pytest.fixture(scope="module")
def case() -> tuple[LandmarkTerm, SequenceFit, Subject]:
    """Return a term over five timesteps, away from its minimum and from its prior's."""
    made = make_tracking_case(timesteps=5)
    shot = sequence_data(made.capture, TrackingSettings())
    reduced = reduce_face_model(made.model, layout_of(made.model))
    state = 0.05 * torch.randn(5, reduced.layout.size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    state[:, 5] -= 0.9
    state[:, 6:] = state[:, 6:].abs() + 0.1
    own = SequenceFit(shot.cameras, state)
    return all_landmarks(reduced, shot.views, own, TrackingSettings()), own, unknown_subject(reduced)


def test_priors_weigh_as_much_in_the_cost_as_in_the_equations(case):
    """Half of the prior would show: the slope may differ by a ten-thousandth of its pull."""
    term, own, subject = case
    equations = term.equations(own.state, subject, own.cameras)
    torch.testing.assert_close(equations.cost, term.cost(own.state, subject, own.cameras))
    pull = float((own.state @ term.model.layout.precision).abs().max())
    for column in range(6, own.state.shape[1]):
        step = torch.zeros_like(own.state)
        step[2, column] = 1e-5
        # Landmarks are linearised, so their slope is exact, and the prior is quadratic.
        there, back = (term.cost(own.state + way * step, subject, own.cameras).sum() for way in (1, -1))
        found = float(there - back) / 4e-5
        assert found == pytest.approx(float(equations.gradient[2, column]), rel=1e-4, abs=1e-4 * pull)
    # Alone, it has the layout's precision.
    blind, precision = term.at(torch.arange(5)), term.model.layout.precision
    blind = type(term)(blind.model, blind.views, torch.zeros_like(blind.weights), blind.sigma, blind.outlier)
    wanted = ((own.state @ precision) * own.state).sum(-1)
    assert float(wanted.min()) > 0.1
    torch.testing.assert_close(blind.cost(own.state, subject, own.cameras), wanted)
    equations = blind.equations(own.state, subject, own.cameras)
    torch.testing.assert_close(equations.cost, wanted)
    torch.testing.assert_close(equations.gradient, own.state @ precision)
    torch.testing.assert_close(equations.hessian, precision.expand_as(equations.hessian))
    term, own, subject = case
    fit = Fit(subject, (own,))
    precision = precision_of_shared(fit, [0], TrackingSettings())
    values = torch.linspace(0.3, 0.9, len(precision), dtype=torch.float64)
    prior = float(joint_cost([term], fit, precision, values)) - float(term.cost(own.state, subject, own.cameras).sum())
    assert prior == pytest.approx(float((precision * values**2).sum()), rel=1e-9)
    _, shared = term.joint_equations(own.state, subject, own.cameras)
    with_prior = shared.with_prior(precision, values)
    torch.testing.assert_close(with_prior.gradient - shared.gradient, precision * values)
    torch.testing.assert_close((with_prior.hessian - shared.hessian).diagonal(), precision)


PLAIN, FAINT = 6, 7
"""Columns of an expression that moves landmarks by centimetres, and of one that moves them by tenths of millimetres."""


@pytest.fixture(scope="module")
def term() -> LandmarkTerm:
    case = make_tracking_case(timesteps=60)
    shares = torch.ones(len(case.model.expression_basis), 1, 1, dtype=torch.float64)
    shares[0], shares[FAINT - PLAIN] = 3, 0.01
    model = replace(case.model, expression_basis=shares * case.model.expression_basis)
    shot = sequence_data(case.capture, TrackingSettings())
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
    assert before[[PLAIN, FAINT]].min() > 0.85
    assert after[PLAIN] > 0.85
    assert after[FAINT] < 0.3
    torch.testing.assert_close(found.state[:, PLAIN], own.state[:, PLAIN], atol=0.03, rtol=0)
    # Motion that does not follow pitch is unchanged.
    turn = own.state[:, :1] - own.state[:, :1].mean()
    change = found.state[:, FAINT : FAINT + 1] - own.state[:, FAINT : FAINT + 1]
    torch.testing.assert_close(change, turn * (turn.T @ change) / (turn.T @ turn), atol=1e-9, rtol=0)
    stop = term.model.layout.expression_columns.stop
    others = [column for column in range(own.state.shape[1]) if not PLAIN <= column < stop]
    assert torch.equal(found.state[:, others], own.state[:, others])
    still = _nodding(term, 0.0)
    assert torch.equal(without_turn_habits(term, unknown_subject(term.model), still).state, still.state)
