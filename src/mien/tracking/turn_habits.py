"""What of expressions goes with the head's turns, taken for as little as one frame knows of it.

Frames are fitted as if their errors were their own. Those of light, shape, focal length and detector are not: they go
with the head's turns and are the same whenever it turns there, and expressions that explain them nod with the head.
How far a coefficient follows turns is therefore known no better than from one frame, however many there are: the
landmarks' information of one frame is weighed against the prior of one frame, so that a jaw that drops as the head
tips back stays, and a cheek that seems to rise by half a millimetre goes. Coefficients are weighed together: those that
undo each other on the face go first, and lips that they close stay closed.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.stages import SequenceFit, box_of

_LEAST_TURN = 1e-4
"""Radians of standard deviation below which a head does not turn."""


def without_turn_habits(term: LandmarkTerm, subject: Subject, own: SequenceFit) -> SequenceFit:
    """The sequence with what in its expressions is linear in the head's turns shrunk to what one frame tells of it.

    Args:
        term: The landmarks of the sequence, in the frame of the fit, where rotations are about zero.
        subject: Of the fit.
        own: Of the fit; poses and joints stay.
    """
    layout, state = term.model.layout, own.state
    turns = _independent(state[:, :2])  # up and down, left and right
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
    return replace(own, state=box_of(layout).clip(changed))


def _independent(turns: Float[Tensor, "v 2"]) -> Float[Tensor, "v q"]:
    """Orthonormal directions of what turns about their mean; fewer where the head hardly turns."""
    left, lengths, _ = torch.linalg.svd(turns - turns.mean(0), full_matrices=False)
    return left[:, lengths > _LEAST_TURN * len(turns) ** 0.5]
