"""The equations that tracking solves are the derivatives of the costs that decide whether it takes a step."""

import pytest
import torch

from mien.tracking import TrackingSettings
from mien.tracking.fitting import Fit, SequenceFit, Subject, layout_of, shot_of
from mien.tracking.fitting.solver import Smoothness
from mien.tracking.landmarks import LandmarkTerm, all_landmarks, reduce_face_model
from mien.tracking.landmarks.shared_fit import joint_cost, precision_of_shared
from mien.tracking.landmarks.term import unknown_subject
from tracking_case import make_tracking_case

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


def test_priors_weigh_as_much_in_the_cost_as_in_the_equations(case) -> None:
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


def test_the_prior_alone_is_quadratic_with_the_layout_s_precision(case) -> None:
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


def test_shared_parameters_have_one_prior_in_the_cost_and_in_the_equations(case) -> None:
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


def test_smoothness_has_the_slope_of_its_cost() -> None:
    random = torch.Generator().manual_seed(3)
    state = torch.randn(9, 2, generator=random, dtype=torch.float64)
    linked = torch.ones(9, dtype=torch.bool)
    linked[[0, 4, -1]] = False
    term = Smoothness(torch.tensor([0.7, 20.0], dtype=torch.float64), linked)
    for _ in range(4):
        direction = torch.randn(9, 2, generator=random, dtype=torch.float64)
        slope = float((term.gradient(state) * direction).sum())
        assert half_slope(term.cost, state, direction) == pytest.approx(slope, rel=1e-6)
