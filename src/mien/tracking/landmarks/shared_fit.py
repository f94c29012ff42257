"""The fit of the parameters that sequences share, to keyframes: identity, landmark bias, focal lengths."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.fitting.fit import Fit, SequenceFit
from mien.tracking.fitting.solver import join_frames, join_shared, place_shared, solve_arrow
from mien.tracking.landmarks.groups import LEFT_EYELIDS, LEFT_IRIS, LIPS, RIGHT_EYELIDS, RIGHT_IRIS
from mien.tracking.landmarks.term import LandmarkTerm, WeightedLinearization, move_subject
from mien.tracking.settings import TrackingSettings

_FOCAL_SIGMA = 0.03
"""Standard deviation of the logarithm of the focal length. The prior counts once for each keyframe. Measured: 0.15 to
1.5 change the focal length from 0.64 to 0.71 of the truth, and no error (log, "Focal length")."""
_RIM_BIAS_SHARE = 0.25
"""Standard deviation of the static offset for lids and lips, as a share of that of other landmarks."""


def fit_shared(
    terms: Sequence[LandmarkTerm], fit: Fit, lenses: Sequence[int | None], settings: TrackingSettings
) -> Fit:
    """Fit identity, landmark bias and unknown focal lengths jointly with the parameters of the keyframes in `fit`."""
    for _ in range(4):
        fit = _fit_jointly(terms, fit, lenses, settings)
        fit = fit_bias(terms, fit)
    return fit


def _fit_jointly(
    terms: Sequence[LandmarkTerm], start: Fit, lenses: Sequence[int | None], settings: TrackingSettings
) -> Fit:
    model, damping = terms[0].model, 1e-3
    precision, size = precision_of_shared(start, lenses, settings), len(start.subject.shared)
    free = len(precision) - size
    fit, values = start, torch.cat([start.subject.shared, start.subject.identity.new_zeros(free)])
    best = joint_cost(terms, fit, precision, values)
    for _ in range(6):
        parts = [
            term.joint_equations(sequence.state, fit.subject, sequence.cameras)
            for term, sequence in zip(terms, fit.sequences, strict=True)
        ]
        frames = join_frames([part for part, _ in parts])
        shared = join_shared([place_shared(part, lens, free) for (_, part), lens in zip(parts, lenses, strict=True)])
        state = torch.cat([sequence.state for sequence in fit.sequences])
        held = model.layout.bounds.held(state, frames.gradient)
        step, shared_step = solve_arrow(frames, shared.with_prior(precision, values), held, damping)
        log_focals, sequences = values[size:] + shared_step[size:], []
        steps = step.split([len(sequence.state) for sequence in fit.sequences])
        for sequence, first, own_step, lens in zip(fit.sequences, start.sequences, steps, lenses, strict=True):
            factor = 1.0 if lens is None else math.exp(float(log_focals[lens]))
            moved = model.layout.bounds.clip(sequence.state + own_step)
            sequences.append(SequenceFit(first.cameras.with_focal(factor), moved))
        candidate = Fit(move_subject(fit.subject, shared_step[:size], model.response), tuple(sequences))
        candidate_values = torch.cat([candidate.subject.shared, log_focals])
        cost = joint_cost(terms, candidate, precision, candidate_values)
        if cost < best:
            fit, values, best, damping = candidate, candidate_values, cost, damping / 5
        else:
            damping *= 10
    return fit


def joint_cost(
    terms: Sequence[LandmarkTerm], fit: Fit, precision: Float[Tensor, " s"], shared: Float[Tensor, " s"]
) -> float:
    """The cost of all timesteps and of the shared parameters, whose prior has these precisions and mean zero."""
    total = (precision * shared**2).sum()
    for term, own in zip(terms, fit.sequences, strict=True):
        total = total + term.cost(own.state, fit.subject, own.cameras).sum()
    return float(total)


def precision_of_shared(fit: Fit, lenses: Sequence[int | None], settings: TrackingSettings) -> Float[Tensor, " s"]:
    """Precisions of the priors of `Subject.shared` and the free focal lengths."""
    subject = torch.ones_like(fit.subject.shared)
    subject[: len(fit.subject.identity)] = settings.identity_weight
    groups = sorted({lens for lens in lenses if lens is not None})
    assert groups == list(range(len(groups))), "lenses are numbered from 0"
    keyframes = [sum(len(own.state) for own, lens in zip(fit.sequences, lenses, strict=True) if lens == group)
                 for group in groups]  # fmt: skip
    return torch.cat([subject, subject.new_tensor(keyframes) * _FOCAL_SIGMA**-2])


def fit_bias(terms: Sequence[LandmarkTerm], fit: Fit) -> Fit:
    """Fit the static offset of every landmark, with all else fixed.

    Beyond the detector's expected offsets, irises get none, because their position determines scale and gaze. Lids and
    lips get little, because closed is closed for everyone. All offsets together contain no translation, rotation or
    scaling, which belong to pose and identity.
    """
    bias, response = fit.subject.bias, terms[0].model.response
    expected = response.mean + response.of_person(fit.subject.person)
    precision = torch.full((len(bias), 1), response.rest_sigma**-2).to(bias)
    precision[list(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS)] *= _RIM_BIAS_SHARE**-2
    hessian, gradient = precision[..., None] * torch.eye(3).to(bias), precision * (bias - expected)
    for term, sequence in zip(terms, fit.sequences, strict=True):
        parts = term.linearized(WeightedLinearization.bias_equations, sequence.state, fit.subject, sequence.cameras)
        for part_hessian, part_gradient in parts:
            hessian, gradient = hessian + part_hessian, gradient + part_gradient
    own = bias - torch.linalg.solve(hessian, gradient) - expected
    own[list(LEFT_IRIS + RIGHT_IRIS)] = 0
    model, weights = terms[0].model, terms[0].weights
    rest = model.layout.face_params(bias.new_zeros(1, model.layout.size), fit.subject.identity)
    positions = model.head_points(rest, torch.zeros_like(bias))[0][0]
    bias = expected + _without_similarity(own, positions, weights)
    return replace(fit, subject=replace(fit.subject, bias=bias))


def _without_similarity(
    offsets: Float[Tensor, "l 3"], positions: Float[Tensor, "l 3"], weights: Float[Tensor, " l"]
) -> Float[Tensor, "l 3"]:
    centered = positions - positions.mean(0)
    axes = torch.eye(3).to(positions)
    motions = [axis.expand_as(centered) for axis in axes]
    motions += [torch.linalg.cross(axis.expand_as(centered), centered) for axis in axes] + [centered]
    basis = torch.stack(motions, dim=-1)
    moving = (offsets != 0).any(1)
    root = weights.sqrt() * moving
    weighted = (basis * root[:, None, None]).flatten(0, 1)
    amount = torch.linalg.lstsq(weighted, (offsets * root[:, None]).flatten()[:, None]).solution
    return (offsets - (basis @ amount)[..., 0]) * moving[:, None]
