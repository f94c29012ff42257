"""Identity and focal lengths of a subject's sequences, fitted to pixels and landmarks of keyframes."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.tracking.fitting.fit import Fit, SequenceFit, choose_keyframes
from mien.tracking.fitting.solver import join_frames, join_shared, place_shared, solve_arrow
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.term import move_subject
from mien.tracking.pixels.outline import OutlineTerm
from mien.tracking.pixels.term import PhotometricTerm

_SHARED_DAMPING = 1e-6
"""Damping of a step of identity and focal length. It is tiny, because the effect that separates focal length from depth
is a thousandth of the effect of either alone. Measured: 1e-3 keeps the focal length where it was (log, "Focal
length")."""
_FOCAL_STEP = 0.2  # largest change of the logarithm of a focal length in one step


def step_shared(
    problem: Problem,
    terms: Sequence[PhotometricTerm],
    outlines: Sequence[OutlineTerm],
    fit: Fit,
    focals: Float[Tensor, " q"],
    keyframes: int,
) -> Fit:
    """Take one Gauss-Newton step of identity and focal lengths, with the keyframes' own parameters eliminated.

    A texture that was estimated with these very poses hardly resists a change that shifts all views alike, but it
    resists a change that the views contradict. So the step gains depth, from parallax. Outlines show the perspective.
    `focals` are the focal lengths from the fit to landmarks, near which a prior keeps them.
    """
    subject, bounds, size = fit.subject, terms[0].layout.bounds, len(fit.subject.shared)
    rows = [choose_keyframes(sequence.state[:, :6], keyframes) for sequence in fit.sequences]
    precision, values = _prior(problem, fit, focals)
    frames, shared = [], []
    for term, outline, own, chosen, lens in zip(terms, outlines, fit.sequences, rows, problem.lenses, strict=True):
        own_frames, own_shared = term.joint_equations(own.state, chosen, subject, own.cameras)
        if outline.weight > 0:
            more_frames, more_shared = outline.joint_equations(own.state, chosen, subject, own.cameras)
            own_frames, own_shared = own_frames.plus(more_frames), own_shared.plus(more_shared)
        frames.append(own_frames)
        shared.append(place_shared(own_shared, lens, len(precision) - size))
    equations = join_frames(frames)
    state = torch.cat([own.state[chosen] for own, chosen in zip(fit.sequences, rows, strict=True)])
    held = bounds.held(state, equations.gradient)
    held[:, 6:] = True  # An expression that all frames share belongs to identity, but would drift here.
    with_prior = join_shared(shared).with_prior(precision, values)
    step, shared_step = solve_arrow(equations, with_prior, held, _SHARED_DAMPING)
    sequences, steps = [], step.split([len(chosen) for chosen in rows])
    for own, own_step, chosen, lens in zip(fit.sequences, steps, rows, problem.lenses, strict=True):
        longer = 0.0 if lens is None else float(shared_step[size + lens])
        factor = math.exp(min(max(longer, -_FOCAL_STEP), _FOCAL_STEP))
        sequences.append(SequenceFit(own.cameras.with_focal(factor), move_like_keyframes(own.state, chosen, own_step)))
    return Fit(move_subject(subject, shared_step[:size], problem.model.response), tuple(sequences))


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
    ridge = 0.3 * torch.eye(7).to(pose)  # ridge regularisation of the affine map from poses to pose steps, in keyframes
    ridge[0, 0] = 0
    slopes = torch.linalg.solve(keys.T @ keys + ridge, keys.T @ step[:, :6])
    return torch.cat([pose + features @ slopes, state[:, 6:]], dim=1)


def _prior(problem: Problem, fit: Fit, focals: Float[Tensor, " q"]) -> tuple[Float[Tensor, " s"], Float[Tensor, " s"]]:
    """Precisions of the shared parameters, and their present offsets from the prior's means."""
    shared, lenses = fit.subject.shared, [lens for lens in problem.lenses if lens is not None]
    weights, values = (shared.new_zeros(max(lenses, default=-1) + 1) for _ in range(2))
    for sequence, lens, first in zip(fit.sequences, problem.lenses, focals, strict=True):
        if lens is not None:
            weights[lens] = 0.04**-2  # of the logarithm, around the fit to landmarks
            values[lens] = (sequence.cameras.K[0, 0, 0] / first).log()
    precision = torch.ones_like(shared)
    precision[: len(fit.subject.identity)] = problem.settings.identity_weight
    return torch.cat([precision, weights]), torch.cat([shared, values])
