"""The fit of the parameters that sequences share, to keyframes: identity, landmark bias, focal lengths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.tracking.fitting.fit import Fit, SequenceFit, Subject
from mien.tracking.fitting.solver import (
    Bounds,
    NormalEquations,
    SharedEquations,
    join_frames,
    join_shared,
    place_shared,
    solve_arrow,
)
from mien.tracking.landmarks.detector_response import DetectorResponse
from mien.tracking.landmarks.groups import LEFT_EYELIDS, LEFT_IRIS, LIPS, RIGHT_EYELIDS, RIGHT_IRIS
from mien.tracking.landmarks.term import LandmarkTerm, move_subject
from mien.tracking.settings import TrackingSettings

_SHARED_ROUNDS = 4  # rounds in which identity and offsets are fitted in turn
_SHARED_ITERATIONS = 6  # iterations of each of these rounds
_FOCAL_SIGMA = 0.03
"""Standard deviation of the logarithm of the focal length. The prior counts once for each keyframe. Measured: 0.15 to
1.5 change the focal length from 0.64 to 0.71 of the truth, and no error (log, "Focal length")."""
_RIM_BIAS_SHARE = 0.25
"""Standard deviation of the static offset for lids and lips, as a share of that of other landmarks."""


@dataclass(frozen=True, eq=False)
class _Joint:
    """A candidate of the joint fit, with the logarithms of the free focal lengths relative to the start."""

    fit: Fit
    log_focals: Float[Tensor, " g"]


def fit_shared(
    terms: Sequence[LandmarkTerm], fit: Fit, lenses: Sequence[int | None], settings: TrackingSettings
) -> Fit:
    """Fit identity, landmark bias and unknown focal lengths jointly with the keyframes' own parameters.

    Args:
        terms: The landmark term of each sequence, over its keyframes.
        fit: The fit so far, at the keyframes.
        lenses: The lens of each sequence. Sequences with the same number share one focal length, up to the size of
            their pictures. None is a known focal length, which is kept.
        settings: Settings with the weights of the priors.
    """
    for _ in range(_SHARED_ROUNDS):
        fit = _fit_jointly(terms, fit, lenses, settings)
        fit = fit_bias(terms, fit)
    return fit


def _fit_jointly(
    terms: Sequence[LandmarkTerm], start: Fit, lenses: Sequence[int | None], settings: TrackingSettings
) -> Fit:
    bounds, damping = terms[0].model.layout.bounds, 1e-3
    precision = precision_of_shared(start, lenses, settings)
    free = len(precision) - len(start.subject.shared)
    at = _Joint(start, start.subject.identity.new_zeros(free))
    best = joint_cost(terms, at.fit, precision, _shared_values(at))
    for _ in range(_SHARED_ITERATIONS):
        frames, shared = _equations(terms, at.fit, lenses, free)
        shared = shared.with_prior(precision, _shared_values(at))
        state = torch.cat([own.state for own in at.fit.sequences])
        step, shared_step = solve_arrow(frames, shared, bounds.held(state, frames.gradient), damping)
        candidate = _move(at, step, shared_step, start, lenses, bounds, terms[0].model.response)
        candidate_cost = joint_cost(terms, candidate.fit, precision, _shared_values(candidate))
        if candidate_cost < best:
            at, best, damping = candidate, candidate_cost, damping / 5
        else:
            damping *= 10
    return at.fit


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


def _shared_values(at: _Joint) -> Float[Tensor, " s"]:
    return torch.cat([at.fit.subject.shared, at.log_focals])


def _equations(
    terms: Sequence[LandmarkTerm], fit: Fit, lenses: Sequence[int | None], free: int
) -> tuple[NormalEquations, SharedEquations]:
    """The equations of the timesteps of all sequences in a row, and of the shared parameters and free focal lengths."""
    frames, shared = [], []
    for term, own, lens in zip(terms, fit.sequences, lenses, strict=True):
        own_frames, own_shared = term.joint_equations(own.state, fit.subject, own.cameras)
        frames.append(own_frames)
        shared.append(place_shared(own_shared, lens, free))
    return join_frames(frames), join_shared(shared)


def _move(
    at: _Joint,
    step: Float[Tensor, "v p"],
    shared_step: Float[Tensor, " s"],
    start: Fit,
    lenses: Sequence[int | None],
    bounds: Bounds,
    response: DetectorResponse,
) -> _Joint:
    subject: Subject = at.fit.subject
    own_steps = len(subject.shared)
    log_focals = at.log_focals + shared_step[own_steps:]
    steps = step.split([len(own.state) for own in at.fit.sequences])
    sequences = []
    for own, first, own_step, lens in zip(at.fit.sequences, start.sequences, steps, lenses, strict=True):
        factor = 1.0 if lens is None else math.exp(float(log_focals[lens]))
        sequences.append(SequenceFit(first.cameras.with_focal(factor), bounds.clip(own.state + own_step)))
    subject = move_subject(subject, shared_step[:own_steps], response)
    return _Joint(Fit(subject, tuple(sequences)), log_focals)


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
        for part in term.linearizations(sequence.state, fit.subject, sequence.cameras):
            part_hessian, part_gradient = part.bias_equations()
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
