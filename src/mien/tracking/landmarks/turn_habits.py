"""Correction of expressions that follow the head's turns.

The fit treats errors of frames as independent. But errors of light, shape, focal length and detector follow the head's
turns and recur whenever the head turns the same way, and expressions that explain them move with the head. So all
frames together know no better than a single frame how far a coefficient follows the turns. The correction weighs the
landmarks' information of one frame against the prior of one frame: a jaw that drops as the head tips back remains, and
a cheek that seems to rise by half a millimetre does not. Coefficients are weighed together, so those that cancel each
other on the face vanish first, and lips that they close stay closed.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.fitting.fit import SequenceFit, Subject
from mien.tracking.landmarks.term import LandmarkTerm

_MIN_TURN = 1e-4
"""Standard deviation of a rotation below which the head counts as still, in radians."""


def without_turn_habits(term: LandmarkTerm, subject: Subject, own: SequenceFit) -> SequenceFit:
    """Shrink the part of a sequence's expressions that is linear in the head's turns to what one frame supports.

    Args:
        term: The landmark term of the sequence, in the frame of the fit, where rotations are about zero.
        subject: The subject of the fit.
        own: The sequence of the fit. Poses and joints stay as they are.
    """
    layout, state = term.model.layout, own.state
    turns = _independent(state[:, :2])  # The turns up and down, left and right.
    columns = layout.expression_columns
    if turns.shape[1] == 0 or columns.start == columns.stop:
        return own
    expression, prior = state[:, columns], layout.precision[columns, columns]
    middle = (state[:, :3] - state[:, :3].median(0).values).norm(dim=1).argmin()[None]
    known = term.at(middle).equations(state[middle], subject, own.cameras).hessian[0, columns, columns] - prior
    following = turns.T @ expression
    kept = torch.linalg.solve(known + prior, known @ following.T).T
    changed = state.clone()
    changed[:, columns] = expression - turns @ (following - kept)
    return replace(own, state=layout.bounds.clip(changed))


def _independent(turns: Float[Tensor, "v 2"]) -> Float[Tensor, "v q"]:
    """Orthonormal basis of the turns about their mean. It has fewer columns if the head hardly turns."""
    left, lengths, _ = torch.linalg.svd(turns - turns.mean(0), full_matrices=False)
    return left[:, lengths > _MIN_TURN * len(turns) ** 0.5]
