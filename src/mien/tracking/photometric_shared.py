"""What the sequences of a subject share, fitted to pixels and landmarks of keyframes: identity and focal lengths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.photometric_term import PhotometricTerm
from mien.tracking.shared_fit import placed
from mien.tracking.solver import joined, joined_shared, solve_arrow
from mien.tracking.stages import Fit, SequenceFit, box_of, choose_keyframes

_DAMPING = 1e-3


@dataclass(frozen=True, eq=False)
class SharedPrior:
    """What is known of the shared parameters before pixels are looked at."""

    lenses: Sequence[int | None]
    """The lens of each sequence; None where the focal length is known."""
    focal: Float[Tensor, " q"]
    """The focal length of each sequence that landmarks led to, pixels."""
    focal_sigma: float
    identity_weight: float

    @property
    def groups(self) -> int:
        """The number of unknown focal lengths."""
        return 1 + max((lens for lens in self.lenses if lens is not None), default=-1)


def step_shared(terms: Sequence[PhotometricTerm], fit: Fit, prior: SharedPrior, keyframes: int) -> Fit:
    """One Gauss-Newton step of identity and focal lengths, the keyframes' own parameters eliminated.

    A texture that was made with these very poses hardly resists a change that shifts every view alike, but it resists
    one that the views contradict: what is gained is depth, from parallax.
    """
    subject, box = fit.subject, box_of(terms[0].layout)
    rows = [choose_keyframes(own.state[:, :6], keyframes) for own in fit.sequences]
    frames, shared = [], []
    for term, own, chosen, lens in zip(terms, fit.sequences, rows, prior.lenses, strict=True):
        own_frames, own_shared = term.joint_equations(own.state, chosen, fit.subject, own.cameras)
        frames.append(own_frames)
        shared.append(placed(own_shared, lens, prior.groups))
    precision, values = _prior(fit, prior, [len(chosen) for chosen in rows])
    equations = joined(frames)
    state = torch.cat([own.state[chosen] for own, chosen in zip(fit.sequences, rows, strict=True)])
    held = box.held(state, equations.gradient)
    held[:, 6:] = True  # an expression that all frames share belongs to identity, but would drift here
    step, shared_step = solve_arrow(equations, joined_shared(shared).with_prior(precision, values), held, _DAMPING)
    sequences = []
    steps = step.split([len(chosen) for chosen in rows])
    for own, own_step, lens in zip(fit.sequences, steps, prior.lenses, strict=True):
        factor = 1.0 if lens is None else math.exp(float(shared_step[len(subject.shared) + lens]))
        # Every frame takes the keyframes' mean step: what the changed identity asks of all of them.
        state = box.clip(own.state + own_step.mean(0))
        sequences.append(SequenceFit(own.cameras.with_focal(factor), state))
    response = terms[0].landmarks.model.response
    return Fit(subject.moved(shared_step[: len(subject.shared)], response), tuple(sequences))


def _prior(fit: Fit, prior: SharedPrior, keyframes: Sequence[int]) -> tuple[Float[Tensor, " s"], Float[Tensor, " s"]]:
    """Precisions of the shared parameters, and how far they are from what is expected."""
    identity = fit.subject.identity
    weights, values = identity.new_zeros(prior.groups), identity.new_zeros(prior.groups)
    for own, lens, first, count in zip(fit.sequences, prior.lenses, prior.focal, keyframes, strict=True):
        if lens is not None:
            weights[lens] += count * prior.focal_sigma**-2
            values[lens] = (own.cameras.K[0, 0, 0] / first).log()
    precision = torch.ones_like(fit.subject.shared)
    precision[: len(identity)] = prior.identity_weight
    return torch.cat([precision, weights]), torch.cat([fit.subject.shared, values])
