"""Identity and focal lengths of a subject's sequences, fitted to pixels and landmarks of keyframes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.tracking.fitting.fit import Fit, SequenceFit, choose_keyframes
from mien.tracking.fitting.solver import join_frames, join_shared, place_shared, solve_arrow
from mien.tracking.landmarks.term import move_subject
from mien.tracking.pixels.outline import OutlineTerm
from mien.tracking.pixels.term import PhotometricTerm

_SHARED_DAMPING = 1e-6
"""Damping of a step of identity and focal length. It is tiny, because the effect that separates focal length from depth
is a thousandth of the effect of either alone. Measured: 1e-3 keeps the focal length where it was (log, "Focal
length")."""
_POSE_SMOOTHING = 0.3  # ridge regularisation of the affine map from poses to pose steps, in keyframes
_FOCAL_STEP = 0.2  # largest change of the logarithm of a focal length in one step


@dataclass(frozen=True, eq=False)
class SharedPrior:
    """Prior of the shared parameters for the fit to pixels."""

    lenses: Sequence[int | None]
    """The lens of each sequence; None if the focal length is known."""
    focal: Float[Tensor, " q"]
    """The focal length of each sequence from the fit to landmarks, in pixels."""
    focal_sigma: float
    """Standard deviation of the logarithm of a focal length."""
    identity_weight: float

    @property
    def groups(self) -> int:
        """The number of unknown focal lengths."""
        return 1 + max((lens for lens in self.lenses if lens is not None), default=-1)


def step_shared(
    terms: Sequence[PhotometricTerm], outlines: Sequence[OutlineTerm], fit: Fit, prior: SharedPrior, keyframes: int
) -> Fit:
    """Take one Gauss-Newton step of identity and focal lengths, with the keyframes' own parameters eliminated.

    A texture that was estimated with these very poses hardly resists a change that shifts all views alike, but it
    resists a change that the views contradict. So the step gains depth, from parallax. Outlines show the perspective.
    """
    subject, bounds = fit.subject, terms[0].layout.bounds
    rows = [choose_keyframes(own.state[:, :6], keyframes) for own in fit.sequences]
    frames, shared = [], []
    for term, outline, own, chosen, lens in zip(terms, outlines, fit.sequences, rows, prior.lenses, strict=True):
        own_frames, own_shared = term.joint_equations(own.state, chosen, fit.subject, own.cameras)
        if outline.weight > 0:
            more_frames, more_shared = outline.joint_equations(own.state, chosen, fit.subject, own.cameras)
            own_frames, own_shared = own_frames.plus(more_frames), own_shared.plus(more_shared)
        frames.append(own_frames)
        shared.append(place_shared(own_shared, lens, prior.groups))
    precision, values = _prior(fit, prior)
    equations = join_frames(frames)
    state = torch.cat([own.state[chosen] for own, chosen in zip(fit.sequences, rows, strict=True)])
    held = bounds.held(state, equations.gradient)
    held[:, 6:] = True  # An expression that all frames share belongs to identity, but would drift here.
    with_prior = join_shared(shared).with_prior(precision, values)
    step, shared_step = solve_arrow(equations, with_prior, held, _SHARED_DAMPING)
    sequences = []
    steps = step.split([len(chosen) for chosen in rows])
    for own, own_step, chosen, lens in zip(fit.sequences, steps, rows, prior.lenses, strict=True):
        longer = 0.0 if lens is None else float(shared_step[len(subject.shared) + lens])
        factor = math.exp(min(max(longer, -_FOCAL_STEP), _FOCAL_STEP))
        sequences.append(SequenceFit(own.cameras.with_focal(factor), move_like_keyframes(own.state, chosen, own_step)))
    response = terms[0].landmarks.model.response
    return Fit(move_subject(subject, shared_step[: len(subject.shared)], response), tuple(sequences))


def move_like_keyframes(
    state: Float[Tensor, "v p"], chosen: Int[Tensor, " k"], step: Float[Tensor, "k p"]
) -> Float[Tensor, "v p"]:
    """Move all timesteps as the keyframes moved: head poses by a step that is affine in the pose, nothing else.

    A longer lens moves heads away in proportion to their depth and turns them farther in proportion to their rotation.
    """
    pose = state[:, :6]
    middle, scale = pose[chosen].mean(0), pose[chosen].std(0, correction=0).clamp_min(1e-3)
    features = torch.cat([torch.ones_like(pose[:, :1]), (pose - middle) / scale], dim=1)
    keys = features[chosen]
    ridge = _POSE_SMOOTHING * torch.eye(7).to(pose)
    ridge[0, 0] = 0
    slopes = torch.linalg.solve(keys.T @ keys + ridge, keys.T @ step[:, :6])
    return torch.cat([pose + features @ slopes, state[:, 6:]], dim=1)


def _prior(fit: Fit, prior: SharedPrior) -> tuple[Float[Tensor, " s"], Float[Tensor, " s"]]:
    """Precisions of the shared parameters, and their present offsets from the prior's means."""
    identity = fit.subject.identity
    weights, values = identity.new_zeros(prior.groups), identity.new_zeros(prior.groups)
    for own, lens, first in zip(fit.sequences, prior.lenses, prior.focal, strict=True):
        if lens is not None:
            weights[lens] = prior.focal_sigma**-2
            values[lens] = (own.cameras.K[0, 0, 0] / first).log()
    precision = torch.ones_like(fit.subject.shared)
    precision[: len(identity)] = prior.identity_weight
    return torch.cat([precision, weights]), torch.cat([fit.subject.shared, values])
