"""Expressions that nod with the head are removed if the face hardly shows them, and stay if it does."""

from dataclasses import replace

import pytest
import torch

from mien.tracking import TrackingSettings
from mien.tracking.fitting import SequenceFit, layout_of, shot_of
from mien.tracking.landmarks import LandmarkTerm, all_landmarks, reduce_face_model, without_turn_habits
from mien.tracking.landmarks.term import unknown_subject
from tracking_case import make_tracking_case

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
    shot_cameras = shot_of(make_tracking_case(timesteps=60).capture, TrackingSettings()).cameras
    return SequenceFit(shot_cameras, state)


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
