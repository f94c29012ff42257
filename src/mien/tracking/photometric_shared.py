"""What the sequences of a subject share, fitted to pixels and landmarks of keyframes: identity and focal lengths."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.tracking.photometric_term import PhotometricTerm
from mien.tracking.landmark_term import Subject
from mien.tracking.shared_fit import placed
from mien.tracking.solver import SharedEquations, joined, joined_shared, solve_arrow
from mien.tracking.stages import Fit, SequenceFit, box_of


def step_shared(
    terms: Sequence[PhotometricTerm],
    rows: Sequence[Int[Tensor, " k"]],
    fit: Fit,
    first: Fit,
    lenses: Sequence[int | None],
    identity_weight: float,
    focal_sigma: float,
    damping: float,
) -> Fit:
    """One Gauss-Newton step of identity and focal lengths; the keyframes' own parameters are eliminated, and left as
    they were: the sequences' own steps move them, over time as well.
    """
    groups = 1 + max((lens for lens in lenses if lens is not None), default=-1)
    identity = fit.subject.identity
    frames, shared = [], []
    for term, own, chosen, lens in zip(terms, fit.sequences, rows, lenses, strict=True):
        own_frames, own_shared = term.joint_equations(own.state, chosen, fit.subject, own.cameras)
        frames.append(own_frames)
        shared.append(placed(own_shared, lens, groups))
    keyframes = [float(sum(len(chosen) for chosen, lens in zip(rows, lenses, strict=True) if lens == group))
                 for group in range(groups)]  # fmt: skip
    precision = torch.cat([torch.full_like(identity, identity_weight), identity.new_tensor(keyframes) * focal_sigma**-2])
    now = [_log_focal(fit, first, lenses.index(group)) for group in range(groups)]
    equations = joined_shared(shared).with_prior(precision, torch.cat([identity, identity.new_tensor(now)]))
    box = box_of(terms[0].layout)
    state = torch.cat([own.state[chosen] for own, chosen in zip(fit.sequences, rows, strict=True)])
    own_equations = joined(frames)
    step, shared_step = solve_arrow(own_equations, equations, box.held(state, own_equations.gradient), damping)
    sequences = []
    steps = step.split([len(chosen) for chosen in rows])
    for own, own_step, chosen, lens in zip(fit.sequences, steps, rows, lenses, strict=True):
        factor = 1.0 if lens is None else math.exp(float(shared_step[len(identity) + lens]))
        # Frames between keyframes follow them, so that a changed identity does not have to be paid for again.
        moved = own.state + _between(own_step, chosen, len(own.state))
        sequences.append(SequenceFit(own.cameras.with_focal(factor), box.clip(moved)))
    return Fit(replace(fit.subject, identity=identity + shared_step[: len(identity)]), tuple(sequences))


def _log_focal(fit: Fit, first: Fit, sequence: int) -> float:
    return math.log(float(fit.sequences[sequence].cameras.K[0, 0, 0] / first.sequences[sequence].cameras.K[0, 0, 0]))


def _between(steps: Float[Tensor, "k p"], rows: Int[Tensor, " k"], count: int) -> Float[Tensor, "v p"]:
    """The mean step for all: what a change of identity asks of every frame."""
    return steps.mean(0, keepdim=True).expand(count, -1)
