"""The stages of tracking from landmarks: each takes what is known so far and returns it refined."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.tracking.landmark_groups import (
    LEFT_EYELIDS,
    LEFT_IRIS,
    LIPS,
    RIGHT_EYELIDS,
    RIGHT_IRIS,
    landmark_weights,
    rigid_weights,
)
from mien.tracking.landmark_model import LandmarkModel
from mien.tracking.landmark_term import LandmarkTerm, Subject
from mien.tracking.parameters import ParameterLayout, pose_only
from mien.tracking.settings import SmoothnessSettings, TrackingSettings
from mien.tracking.solver import Box, Smoothness, joined, joined_shared, minimize_frames, solve_arrow, solve_chain

_RIGID_ITERATIONS = 15
_RIGID_OUTLIER = 40.0
"""Sigmas: a head that is turned away lies far from the frontal start."""
_KEYFRAME_ROUNDS, _KEYFRAME_ITERATIONS = 4, 6
_FRAME_ITERATIONS = 12
_SEQUENCE_ROUNDS, _SEQUENCE_ITERATIONS = 2, 5
_RIM_BIAS_SHARE = 0.25
"""Of other landmarks' standard deviation of the static offset: for lids and lips."""
_LINE_SEARCH = (1.0, 0.5, 0.25, 0.1)
_FOCAL_SIGMA, _KNOWN_FOCAL_SIGMA = 0.03, 1e-6
"""Of the logarithm of the focal length."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The state of tracking v frames in which a face was found."""

    subject: Subject
    state: Float[Tensor, "v p"]
    """Per-frame parameters, in the order of the layout."""


def fit_head_pose(
    model: LandmarkModel, detected: Float[Tensor, "v l 2"], subject: Subject, settings: TrackingSettings
) -> Float[Tensor, "v 6"]:
    """Head rotation and translation of every frame alone, from points that expressions hardly move."""
    weights = rigid_weights()
    rigid = (weights > 0).nonzero()[:, 0]
    model = model.at(rigid, pose_only(model.layout))
    detected, subject = detected[:, rigid], replace(subject, bias=subject.bias[rigid])
    at_rest = model.layout.face_params(detected.new_zeros(1, 6), subject.identity)
    points = model.head_points(at_rest, subject.bias)[0][0]
    start = _facing_the_camera(points, detected, subject.camera)
    term = replace(landmark_term(model, detected, weights[rigid], start, subject, settings), outlier=_RIGID_OUTLIER)
    return minimize_frames(
        lambda state: term.equations(state, subject), lambda state: term.cost(state, subject),
        start, _box(model.layout), _RIGID_ITERATIONS,
    )  # fmt: skip


def _facing_the_camera(
    points: Float[Tensor, "l 3"], detected: Float[Tensor, "v l 2"], camera: Camera
) -> Float[Tensor, "v 6"]:
    """Head poses without rotation whose size and place are those of the detected points."""
    centre = detected.mean(1)
    spread = (detected - centre[:, None]).norm(dim=-1).mean(1)
    depth = camera.K[0, 0] * (points - points.mean(0))[:, :2].norm(dim=-1).mean() / spread
    across = (centre - camera.K[:2, 2]) / camera.K[0, 0] * depth[:, None]
    in_camera = torch.cat([across, depth[:, None]], dim=1)
    in_world = (in_camera - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return torch.cat([torch.zeros_like(in_world), in_world - points.mean(0)], dim=1)


def landmark_term(
    model: LandmarkModel,
    detected: Float[Tensor, "v l 2"],
    weights: Float[Tensor, " l"],
    state: Float[Tensor, "v p"],
    subject: Subject,
    settings: TrackingSettings,
) -> LandmarkTerm:
    """The cost of landmarks whose errors are known in metres on a face at its median depth."""
    camera = subject.camera
    depth = (state[:, 3:6] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).median()
    sigma = settings.landmark_sigma * float(camera.K[0, 0] / depth)
    weights = weights * (settings.independent_landmarks / weights.sum())
    return LandmarkTerm(model, detected, weights, sigma, settings.outlier)


def choose_keyframes(pose: Float[Tensor, "v 6"], count: int) -> Int[Tensor, " k"]:
    """Frames whose head rotations lie as far apart as can be, the first one in the middle of them all."""
    rotations = pose[:, :3]
    chosen = [int((rotations - rotations.median(0).values).norm(dim=1).argmin())]
    distance = (rotations - rotations[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(pose)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (rotations - rotations[chosen[-1]]).norm(dim=1))
        distance[chosen] = -1
    return torch.tensor(sorted(chosen))


def fit_keyframes(term: LandmarkTerm, fit: Fit, settings: TrackingSettings) -> Fit:
    """Identity, landmark bias and (if unknown) focal length, jointly with the keyframes' own parameters."""
    for _ in range(_KEYFRAME_ROUNDS):
        fit = _fit_jointly(term, fit, settings)
        fit = fit_bias(term, fit, settings)
    return fit


def _fit_jointly(term: LandmarkTerm, start: Fit, settings: TrackingSettings) -> Fit:
    box, damping, fit = _box(term.model.layout), 1e-3, start
    focal_sigma = _KNOWN_FOCAL_SIGMA if settings.focal is not None else _FOCAL_SIGMA
    precision = torch.full((len(start.subject.identity) + 1,), settings.identity_weight).to(start.state)
    precision[-1] = len(start.state) * focal_sigma**-2

    def shared_values(candidate: Fit) -> Float[Tensor, " s"]:
        log_focal = (candidate.subject.camera.K[0, 0] / start.subject.camera.K[0, 0]).log()
        return torch.cat([candidate.subject.identity, log_focal[None]])

    def cost(candidate: Fit) -> float:
        prior = (precision * shared_values(candidate) ** 2).sum()
        return float(term.cost(candidate.state, candidate.subject).sum() + prior)

    best = cost(fit)
    for _ in range(_KEYFRAME_ITERATIONS):
        linearized = list(term.linearizations(fit.state, fit.subject, with_identity=True))
        frames = joined([part.frame_equations(term.model.layout.precision) for part in linearized])
        shared = joined_shared([part.shared_equations() for part in linearized])
        shared = shared.with_prior(precision, shared_values(fit))
        step, shared_step = solve_arrow(frames, shared, box.held(fit.state, frames.gradient), damping)
        camera = _with_focal(fit.subject.camera, math.exp(float(shared_step[-1])))
        subject = replace(fit.subject, identity=fit.subject.identity + shared_step[:-1], camera=camera)
        candidate = Fit(subject, box.clip(fit.state + step))
        candidate_cost = cost(candidate)
        if candidate_cost < best:
            fit, best, damping = candidate, candidate_cost, damping / 5
        else:
            damping *= 10
    return fit


def fit_bias(term: LandmarkTerm, fit: Fit, settings: TrackingSettings) -> Fit:
    """The static offset of every landmark, all else fixed.

    Irises get none (their place tells scale and gaze), lids and lips little (closed is closed for everyone), and the
    offsets together hold no translation, rotation or scaling, which belong to pose and identity.
    """
    bias = fit.subject.bias
    precision = torch.full((len(bias), 1), settings.bias_sigma**-2).to(bias)
    precision[list(LIPS + LEFT_EYELIDS + RIGHT_EYELIDS)] *= _RIM_BIAS_SHARE**-2
    hessian, gradient = precision[..., None] * torch.eye(3).to(bias), precision * bias
    for part in term.linearizations(fit.state, fit.subject):
        part_hessian, part_gradient = part.bias_equations()
        hessian, gradient = hessian + part_hessian, gradient + part_gradient
    bias = bias - torch.linalg.solve(hessian, gradient)
    bias[list(LEFT_IRIS + RIGHT_IRIS)] = 0
    rest = term.model.layout.face_params(fit.state.new_zeros(1, term.model.layout.size), fit.subject.identity)
    positions = term.model.head_points(rest, torch.zeros_like(bias))[0][0]
    return replace(fit, subject=replace(fit.subject, bias=_without_similarity(bias, positions, term.weights)))


def _without_similarity(
    offsets: Float[Tensor, "l 3"], positions: Float[Tensor, "l 3"], weights: Float[Tensor, " l"]
) -> Float[Tensor, "l 3"]:
    centred = positions - positions.mean(0)
    axes = torch.eye(3).to(positions)
    motions = [axis.expand_as(centred) for axis in axes]
    motions += [torch.linalg.cross(axis.expand_as(centred), centred) for axis in axes] + [centred]
    basis = torch.stack(motions, dim=-1)
    moving = (offsets != 0).any(1)
    root = weights.sqrt() * moving
    weighted = (basis * root[:, None, None]).flatten(0, 1)
    amount = torch.linalg.lstsq(weighted, (offsets * root[:, None]).flatten()[:, None]).solution
    return (offsets - (basis @ amount)[..., 0]) * moving[:, None]


def fit_frames(term: LandmarkTerm, fit: Fit) -> Fit:
    """Pose, expression and eyes of every frame alone."""
    state = minimize_frames(
        lambda state: term.equations(state, fit.subject), lambda state: term.cost(state, fit.subject),
        fit.state, _box(term.model.layout), _FRAME_ITERATIONS,
    )  # fmt: skip
    return replace(fit, state=state)


def fit_sequence(term: LandmarkTerm, fit: Fit, smoothness: Smoothness, settings: TrackingSettings) -> Fit:
    """All frames together under the smoothness cost, alternating with the landmarks' bias."""
    for _ in range(_SEQUENCE_ROUNDS):
        fit = fit_bias(term, fit, settings)
        fit = _fit_chain(term, fit, smoothness)
    return fit


def _fit_chain(term: LandmarkTerm, fit: Fit, smoothness: Smoothness) -> Fit:
    box = _box(term.model.layout)

    def cost(state: Float[Tensor, "v p"]) -> float:
        return float(term.cost(state, fit.subject).sum() + smoothness.cost(state))

    state, best = fit.state, cost(fit.state)
    for _ in range(_SEQUENCE_ITERATIONS):
        equations = term.equations(state, fit.subject)
        held = box.held(state, equations.gradient + smoothness.gradient(state))
        step = solve_chain(equations, smoothness, state, held)
        candidates = (box.clip(state + fraction * step) for fraction in _LINE_SEARCH)
        improved = next(((c, value) for c in candidates if (value := cost(c)) < best), None)
        if improved is None:
            break
        converged = best - improved[1] < 1e-4 * best
        state, best = improved
        if converged:
            break
    return replace(fit, state=state)


def smoothness_of(
    layout: ParameterLayout, valid: Bool[Tensor, " t"], fps: float, settings: SmoothnessSettings
) -> Smoothness:
    """The smoothness cost over the valid frames; missing frames cut the chain."""
    sigmas = torch.full((layout.size,), math.inf, dtype=torch.float64)
    sigmas[:3] = settings.rotation
    sigmas[3:5] = settings.translation
    sigmas[5] = settings.depth
    names = layout.names[layout.expression_columns]
    slow = torch.tensor([not name.startswith("eye") for name in names], dtype=torch.bool)
    sigmas[layout.expression_columns][slow] = settings.expression
    frames = valid.nonzero()[:, 0]
    linked = torch.zeros(len(frames), dtype=torch.bool)
    if len(frames) > 2:
        linked[1:-1] = frames[2:] - frames[:-2] == 2
    return Smoothness((sigmas / fps**2) ** -2, linked)


def widen(pose: Float[Tensor, "v 6"], layout: ParameterLayout) -> Float[Tensor, "v p"]:
    """Head poses as whole vectors: everything else at rest."""
    return torch.cat([pose, pose.new_zeros(len(pose), layout.size - 6)], dim=1)


def all_landmarks(
    model: LandmarkModel, detected: Float[Tensor, "v l 2"], fit: Fit, settings: TrackingSettings
) -> LandmarkTerm:
    """The cost of all landmarks at the depth of a fit."""
    return landmark_term(model, detected, landmark_weights(), fit.state, fit.subject, settings)


def _box(layout: ParameterLayout) -> Box:
    return Box(layout.lower, layout.upper)


def _with_focal(camera: Camera, factor: float) -> Camera:
    K = camera.K.clone()
    K[0, 0] *= factor
    K[1, 1] *= factor
    return replace(camera, K=K)
