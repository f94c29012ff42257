"""The stages of tracking from landmarks. Each stage takes the fit so far and returns it refined."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.rotation import axis_angle_from_matrix
from mien.tracking.fitting.fit import (
    Fit,
    Progress,
    SequenceFit,
    Subject,
    choose_keyframes,
    fit_of,
    show_progress,
    widen,
)
from mien.tracking.fitting.parameters import pose_only
from mien.tracking.fitting.solver import Smoothness, minimize_frames, solve_chain
from mien.tracking.fitting.views import CameraBatch, Views
from mien.tracking.landmarks.groups import rigid_weights
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.problem import Problem
from mien.tracking.landmarks.shared_fit import fit_bias, fit_shared
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks, landmark_term, unknown_subject

FIRST_OUTLIER = 40.0  # outlier threshold of the first head pose, in standard deviations
_SEQUENCE_ROUNDS = 2  # times that the fit over time alternates with the fit of the landmarks' bias
_SEQUENCE_ITERATIONS = 10  # largest number of iterations of the fit over time, in all rounds together

FRAMES_AT_ONCE = 512
"""Number of timesteps fitted in one batch, which takes about 100 MB of memory."""
_COSTS = {"head pose": 10, "identity": 10, "frames": 140, "sequence": 100}
"""Relative duration of each stage per timestep, for the progress bar, as in a clip of 15,000; multiples of ten."""


def fit_landmarks(problem: Problem) -> Fit:
    """Fit all sequences of a subject to their landmarks.

    The stages are the head pose of every timestep alone, identity and unknown focal lengths from keyframes
    (`fit_shared`), every timestep alone, and all timesteps of each sequence together, smooth over time.
    """
    total = problem.frames * sum(_COSTS.values())
    with show_progress("Tracking", "landmarks", total, problem.callback) as progress:
        start = fit_of(problem.cache.get_or_compute("identity", lambda: _identify(problem, progress).tensors()))
        progress.advance(problem.frames * _COSTS["identity"], "identity")
        return _fit_motion(problem, start.subject, [sequence.cameras for sequence in start.sequences], progress)


def follow_landmarks(problem: Problem, subject: Subject, cameras: Sequence[CameraBatch]) -> Fit:
    """Fit only the motion of sequences to their landmarks. The subject and the cameras stay as they are."""
    total = problem.frames * (_COSTS["frames"] + _COSTS["sequence"])
    with show_progress("Tracking held-out sequences", "landmarks", total, problem.callback) as progress:
        return _fit_motion(problem, subject, cameras, progress, fixed_subject=True)


def _identify(problem: Problem, progress: Progress) -> Fit:
    """Fit the head poses of all timesteps, then identity and unknown focal lengths to keyframes."""
    model, settings = problem.model, problem.settings
    subject, starts = unknown_subject(model), []
    for data in problem.data:
        pose = fit_head_pose(model, data.views, data.cameras, subject)
        starts.append(SequenceFit(data.cameras, widen(pose, model.layout)))
        _advance(progress, "head pose", 1, len(pose))
    start = Fit(subject, tuple(starts))
    progress.show("identity", lambda: start)
    chosen = [choose_keyframes(sequence.state[:, :6], settings.keyframes) for sequence in starts]
    terms = [term.at(rows) for term, rows in zip(problem.landmark_terms(start), chosen, strict=True)]
    keyframes = [replace(each, state=each.state[rows]) for each, rows in zip(starts, chosen, strict=True)]
    return fit_shared(terms, Fit(subject, tuple(keyframes)), problem.lenses, settings)


def _fit_motion(
    problem: Problem,
    subject: Subject,
    cameras: Sequence[CameraBatch],
    progress: Progress,
    fixed_subject: bool = False,
) -> Fit:
    """Fit every timestep alone, then all timesteps of each sequence together."""
    model, settings, terms, sequences = problem.model, problem.settings, [], []
    for number, (data, batch) in enumerate(zip(problem.data, cameras, strict=True)):
        pose = fit_head_pose(model, data.views, batch, subject)
        start = SequenceFit(batch, widen(pose, model.layout))
        terms.append(all_landmarks(model, data.views, start, settings))
        sequences.append(_fit_frames(problem, terms[-1], subject, start, f"frames-{number}", progress))
    fit = Fit(subject, tuple(sequences))
    progress.show("sequence", lambda: Fit(subject, tuple(sequences)))
    smoothness, advance = problem.smoothness(fit), partial(_advance, progress, "sequence", _SEQUENCE_ITERATIONS)

    def alternate(fit: Fit) -> dict[str, Tensor]:
        fit = fit if fixed_subject else fit_bias(terms, fit)
        parts = zip(terms, fit.sequences, smoothness, strict=True)
        return replace(fit, sequences=tuple(_fit_chain(*part, fit.subject, advance) for part in parts)).tensors()

    for number in range(_SEQUENCE_ROUNDS):
        fit = fit_of(problem.cache.get_or_compute(f"sequence-{number}", partial(alternate, fit)))
    return fit


def _advance(progress: Progress, stage: str, parts: int, timesteps: int) -> None:
    """Report that one of the `parts` of a stage's work at some timesteps is done."""
    progress.advance(timesteps * _COSTS[stage] // parts, stage)


def _fit_frames(
    problem: Problem, term: LandmarkTerm, subject: Subject, start: SequenceFit, name: str, progress: Progress
) -> SequenceFit:
    """Fit pose, expression and eyes at every timestep alone. Batches are kept under names that begin with `name`."""

    def fitted(rows: Int[Tensor, " k"]) -> dict[str, Tensor]:
        part = term.at(rows)
        state = minimize_frames(
            lambda state: part.equations(state, subject, start.cameras),
            lambda state: part.cost(state, subject, start.cameras),
            start.state[rows], term.model.layout.bounds, iterations=12,
        )  # fmt: skip
        return {"state": state}

    parts = []
    for index, rows in enumerate(torch.arange(len(start.state)).split(FRAMES_AT_ONCE)):
        parts.append(problem.cache.get_or_compute(f"{name}-{index}", partial(fitted, rows))["state"])
        _advance(progress, "frames", 1, len(rows))
    return replace(start, state=torch.cat(parts))


def _fit_chain(
    term: LandmarkTerm, start: SequenceFit, smoothness: Smoothness, subject: Subject, advance: Callable[[int], None]
) -> SequenceFit:
    """Fit all timesteps of a sequence together, by Gauss-Newton steps with a line search."""
    bounds, cameras = term.model.layout.bounds, start.cameras
    iterations = _SEQUENCE_ITERATIONS // _SEQUENCE_ROUNDS

    def cost(state: Float[Tensor, "v p"]) -> float:
        return float(term.cost(state, subject, cameras).sum() + smoothness.cost(state))

    state, best = start.state, cost(start.state)
    for done in range(iterations):
        equations = term.equations(state, subject, cameras)
        held = bounds.held(state, equations.gradient + smoothness.gradient(state))
        step = solve_chain(equations, smoothness, state, held)
        candidates = (bounds.clip(state + fraction * step) for fraction in (1.0, 0.5, 0.25, 0.1))
        improved = next(((c, value) for c in candidates if (value := cost(c)) < best), None)
        converged = improved is None or best - improved[1] < 1e-4 * best
        state, best = improved or (state, best)
        advance(len(state) * (iterations - done if converged else 1))
        if converged:
            break
    return replace(start, state=state)


def fit_head_pose(model: LandmarkModel, views: Views, cameras: CameraBatch, subject: Subject) -> Float[Tensor, "v 6"]:
    """Fit head rotation and translation at each timestep alone, from landmarks that expressions hardly move.

    Each picture is fitted by itself first, starting from a head that faces its camera. If several cameras see a
    timestep, their joint fit starts from the one of these poses that suits all of them best.
    """
    weights = rigid_weights()
    rigid = (weights > 0).nonzero()[:, 0]
    model = model.at(rigid, pose_only(model.layout))
    views, weights = views.of_landmarks(rigid), weights[rigid]
    subject = replace(subject, bias=subject.bias[rigid])
    at_rest = model.layout.face_params(views.detected.new_zeros(1, 6), subject.identity)
    points = model.head_points(at_rest, subject.bias)[0][0]

    def fit_term(views: Views, state: Float[Tensor, "v 6"]) -> LandmarkTerm:
        return replace(landmark_term(model, views, weights, state, cameras), outlier=FIRST_OUTLIER)

    def minimize(term: LandmarkTerm, start: Float[Tensor, "v 6"]) -> Float[Tensor, "v 6"]:
        return minimize_frames(
            lambda state: term.equations(state, subject, cameras), lambda state: term.cost(state, subject, cameras),
            start, model.layout.bounds, iterations=15,
        )  # fmt: skip

    alone = views.apart()
    start = _facing_the_cameras(points, alone.detected, cameras[alone.camera])
    poses = minimize(fit_term(alone, start), start)
    if len(poses) == views.rows:
        return poses
    term = fit_term(views, poses[_first_picture(views)])
    return minimize(term, _best_for_all(term, poses, subject, cameras))


def _facing_the_cameras(
    points: Float[Tensor, "l 3"], detected: Float[Tensor, "n l 2"], cameras: CameraBatch
) -> Float[Tensor, "n 6"]:
    """Head poses that look straight into each picture's camera and match the size and place of the detected points."""
    center = detected.mean(1)
    spread = (detected - center[:, None]).norm(dim=-1).mean(1)
    focal = cameras.K[:, 0, 0]
    depth = focal * (points - points.mean(0))[:, :2].norm(dim=-1).mean() / spread
    across = (center - cameras.K[:, :2, 2]) / focal[:, None] * depth[:, None]
    in_camera = torch.cat([across, depth[:, None]], dim=1)
    R_world_camera = cameras.viewmat[:, :3, :3].mT
    in_world = (R_world_camera @ (in_camera - cameras.viewmat[:, :3, 3])[..., None])[..., 0]
    R_world_head = R_world_camera @ torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(points)
    return torch.cat([axis_angle_from_matrix(R_world_head), in_world - R_world_head @ points.mean(0)], dim=1)


def _first_picture(views: Views) -> Tensor:
    """The index of the first picture of each timestep."""
    first = torch.zeros(views.rows, dtype=torch.long)
    first[views.row.flip(0)] = torch.arange(len(views.row) - 1, -1, -1)
    return first


def _best_for_all(
    term: LandmarkTerm, poses: Float[Tensor, "n 6"], subject: Subject, cameras: CameraBatch
) -> Float[Tensor, "v 6"]:
    """For each timestep, the pose that fits all of its pictures best, out of the poses fitted to single pictures."""
    views = term.views
    best = poses[_first_picture(views)]
    lowest = term.cost(best, subject, cameras)
    for camera in views.camera.unique():
        own = views.camera == camera
        candidate = best.clone()
        candidate[views.row[own]] = poses[own]
        cost = term.cost(candidate, subject, cameras)
        better = cost < lowest
        best, lowest = torch.where(better[:, None], candidate, best), torch.where(better, cost, lowest)
    return best
