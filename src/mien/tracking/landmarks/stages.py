"""The stages of tracking from landmarks. Each stage takes the fit so far and returns it refined."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.machine.progress import progress_bar
from mien.tracking.fitting.fit import (
    Course,
    Fit,
    SequenceFit,
    Subject,
    Watch,
    choose_keyframes,
    fit_of,
    smoothness_of,
    widen,
)
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.shot import Shot
from mien.tracking.fitting.solver import Smoothness, minimize_frames, solve_chain
from mien.tracking.fitting.views import CameraBatch
from mien.tracking.landmarks.head_pose import fit_head_pose
from mien.tracking.landmarks.model import LandmarkModel
from mien.tracking.landmarks.shared_fit import fit_bias, fit_shared
from mien.tracking.landmarks.term import LandmarkTerm, all_landmarks, unknown_subject
from mien.tracking.settings import TrackingSettings

_FRAME_ITERATIONS = 12  # number of iterations of the fit of single frames
_SEQUENCE_ROUNDS = 2  # rounds of the fit over time, with new turn habits in each
_SEQUENCE_ITERATIONS = 10  # largest number of iterations of the fit over time, in all rounds together

FRAMES_AT_ONCE = 512
"""Number of timesteps fitted in one batch, which takes about 100 MB of memory."""
_LINE_SEARCH = (1.0, 0.5, 0.25, 0.1)
_COSTS = {"head pose": 10, "identity": 10, "frames": 140, "sequence": 100}
"""Relative duration of each stage per timestep, for the progress bar, as in a clip of 15,000; multiples of ten."""


def fit_landmarks(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> Fit:
    """Fit all sequences of a subject to their landmarks.

    The stages are the head pose of every timestep alone, identity and unknown focal lengths from keyframes
    (`fit_shared`), every timestep alone, and all timesteps of each sequence together, smooth over time.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        lenses: Index of each sequence's unknown focal length (`lenses_of`).
        settings: Settings of the whole tracking.
        cache: Keeps the pieces from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    frames = sum(int(shot.valid.sum()) for shot in shots)
    total = frames * sum(_COSTS.values())
    with progress_bar("Tracking", total=total) as bar:
        course = Course("landmarks", total, bar, watch)
        known = fit_of(cache.get_or_compute("identity", lambda: _identify(model, shots, lenses, settings, course)))
        course.advance(frames * _COSTS["identity"], "identity")
        cameras = [key.cameras for key in known.sequences]
        return _fit_motion(model, shots, cameras, known.subject, settings, cache, course)


def follow_landmarks(
    model: LandmarkModel,
    shots: Sequence[Shot],
    cameras: Sequence[CameraBatch],
    subject: Subject,
    settings: TrackingSettings,
    cache: StageCache,
    watch: Watch,
) -> Fit:
    """Fit only the motion of sequences to their landmarks. The subject and the cameras stay as they are.

    Args:
        model: The face model reduced to its landmarks.
        shots: The sequences.
        cameras: The cameras of each sequence, in the frame of its shot.
        subject: The person, as other sequences show them.
        settings: Settings of the whole tracking.
        cache: Keeps the pieces from which an interrupted fit of the same input resumes.
        watch: Receives the progress.
    """
    total = sum(int(shot.valid.sum()) for shot in shots) * (_COSTS["frames"] + _COSTS["sequence"])
    with progress_bar("Tracking held-out sequences", total=total) as bar:
        course = Course("landmarks", total, bar, watch)
        return _fit_motion(model, shots, cameras, subject, settings, cache, course, fixed_subject=True)


def _fit_motion(
    model: LandmarkModel,
    shots: Sequence[Shot],
    cameras: Sequence[CameraBatch],
    subject: Subject,
    settings: TrackingSettings,
    cache: StageCache,
    course: Course,
    fixed_subject: bool = False,
) -> Fit:
    """Fit every timestep alone, then all timesteps of each sequence together."""
    terms, sequences = [], []
    for number, (shot, own_cameras) in enumerate(zip(shots, cameras, strict=True)):
        pose = fit_head_pose(model, shot.views, own_cameras, subject, settings)
        own = SequenceFit(own_cameras, widen(pose, model.layout))
        terms.append(all_landmarks(model, shot.views, own, settings))
        advance_frames, name = partial(_advance, course, "frames", 1), f"frames-{number}"
        sequences.append(fit_frames(terms[-1], subject, own, advance_frames, cache, name))

    alone = Fit(subject, tuple(sequences))
    course.show("sequence", lambda: alone)
    smoothness = [smoothness_of(model.layout, shot.valid, shot.fps, settings.smoothness, own.cameras)
                  for shot, own in zip(shots, sequences, strict=True)]  # fmt: skip
    advance = partial(_advance, course, "sequence", _SEQUENCE_ITERATIONS)
    return fit_sequences(terms, alone, smoothness, advance, cache, fixed_subject)


def _advance(course: Course, stage: str, parts: int, timesteps: int) -> None:
    """Report that one of the `parts` of a stage's work at some timesteps is done."""
    course.advance(timesteps * _COSTS[stage] // parts, stage)


def _identify(
    model: LandmarkModel,
    shots: Sequence[Shot],
    lenses: Sequence[int | None],
    settings: TrackingSettings,
    course: Course,
) -> dict[str, Tensor]:
    """Fit the head poses of all timesteps, then identity and unknown focal lengths to keyframes; the fit as tensors."""
    subject, starts = unknown_subject(model), []
    for shot in shots:
        pose = fit_head_pose(model, shot.views, shot.cameras, subject, settings)
        starts.append(SequenceFit(shot.cameras, widen(pose, model.layout)))
        _advance(course, "head pose", 1, len(pose))
    course.show("identity", lambda: Fit(subject, tuple(starts)))
    terms, keyframes = [], []
    for shot, own in zip(shots, starts, strict=True):
        chosen = choose_keyframes(own.state[:, :6], settings.keyframes)
        terms.append(all_landmarks(model, shot.views, own, settings).at(chosen))
        keyframes.append(replace(own, state=own.state[chosen]))
    return fit_shared(terms, Fit(subject, tuple(keyframes)), lenses, settings).tensors()


def fit_frames(
    term: LandmarkTerm,
    subject: Subject,
    own: SequenceFit,
    advance: Callable[[int], None] = lambda timesteps: None,
    cache: StageCache | None = None,
    name: str = "frames",
) -> SequenceFit:
    """Fit pose, expression and eyes at every timestep alone. `advance` receives the number of finished timesteps."""
    cache, parts = cache or StageCache(), []

    def fitted(rows: Int[Tensor, " k"]) -> dict[str, Tensor]:
        part = term.at(rows)
        state = minimize_frames(
            lambda state: part.equations(state, subject, own.cameras),
            lambda state: part.cost(state, subject, own.cameras),
            own.state[rows], term.model.layout.bounds, _FRAME_ITERATIONS,
        )  # fmt: skip
        return {"state": state}

    for index, rows in enumerate(torch.arange(len(own.state)).split(FRAMES_AT_ONCE)):
        parts.append(cache.get_or_compute(f"{name}-{index}", partial(fitted, rows))["state"])
        advance(len(rows))
    return replace(own, state=torch.cat(parts))


def fit_sequences(
    terms: Sequence[LandmarkTerm],
    fit: Fit,
    smoothness: Sequence[Smoothness],
    advance: Callable[[int], None] = lambda timesteps: None,
    cache: StageCache | None = None,
    fixed_subject: bool = False,
) -> Fit:
    """Fit all timesteps of each sequence together under its smoothness cost, in turn with the landmarks' bias.

    `advance` receives the number of finished timesteps in each of the iterations. If the subject is fixed, the bias
    stays as it is.
    """
    cache = cache or StageCache()

    def round_from(fit: Fit) -> dict[str, Tensor]:
        fit = fit if fixed_subject else fit_bias(terms, fit)
        parts = zip(terms, fit.sequences, smoothness, strict=True)
        chains = tuple(_fit_chain(term, fit.subject, own, smooth, advance) for term, own, smooth in parts)
        return replace(fit, sequences=chains).tensors()

    for number in range(_SEQUENCE_ROUNDS):
        fit = fit_of(cache.get_or_compute(f"sequence-{number}", partial(round_from, fit)))
    return fit


def _fit_chain(
    term: LandmarkTerm,
    subject: Subject,
    own: SequenceFit,
    smoothness: Smoothness,
    advance: Callable[[int], None],
) -> SequenceFit:
    bounds = term.model.layout.bounds
    iterations = _SEQUENCE_ITERATIONS // _SEQUENCE_ROUNDS

    def cost(state: Float[Tensor, "v p"]) -> float:
        return float(term.cost(state, subject, own.cameras).sum() + smoothness.cost(state))

    def step_from(state: Float[Tensor, "v p"]) -> Float[Tensor, "v p"]:
        equations = term.equations(state, subject, own.cameras)
        held = bounds.held(state, equations.gradient + smoothness.gradient(state))
        return solve_chain(equations, smoothness, state, held)

    state, best = own.state, cost(own.state)
    for done in range(iterations):
        step = step_from(state)
        candidates = (bounds.clip(state + fraction * step) for fraction in _LINE_SEARCH)
        improved = next(((c, value) for c in candidates if (value := cost(c)) < best), None)
        converged = improved is None or best - improved[1] < 1e-4 * best
        state, best = improved or (state, best)
        advance(len(state) * (iterations - done if converged else 1))
        if converged:
            break
    return replace(own, state=state)
