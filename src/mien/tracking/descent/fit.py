"""The `paper` schedule: the first frame, then each next one, then gradient descent over all frames in random order."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mien.adam import Moments
from mien.face.params import most_frontal_camera
from mien.machine.progress import Advance
from mien.tracking.descent.epochs import RATES, Descent, apply_adam
from mien.tracking.descent.scene import PaperScene, first_state, paper_scene
from mien.tracking.descent.terms import (
    COLOR_EPSILON,
    Target,
    color_term,
    face_of,
    guess_texture,
    landmark_terms,
    light_term,
    pose_vertices,
    roughness_gradient,
    shared_terms,
    visibility_of,
    without_smooth_difference,
)
from mien.tracking.fitting.fit import Fit, show_progress
from mien.tracking.fitting.resume import StageCache
from mien.tracking.landmarks.problem import Problem
from mien.tracking.pixels.texture import PhotometricFit, SkinTexture, texture_space

_LAST_RATE = 0.1  # factor of the learning rates at the last of a frame's steps
_TEXTURE_FRAMES = 40  # number of frames of each sequence from which texture and light are fitted before the epochs
_LOST_LANDMARKS = 3.0  # standard deviations by which landmarks must be farther off than in their own fit to be lost
_FIRST_CONVERGED = 0.01  # share by which a turn of the very first frame's steps must lower its cost for another turn


def fit_by_descent(
    problem: Problem, fit: Fit, refined: PhotometricFit | None = None, known: PhotometricFit | None = None
) -> PhotometricFit:
    """Refine a fit as in the supplement of GaussianAvatars, section A.

    The global epochs run at the end. If the settings start from landmarks, the pass along the frames runs first. A
    frame whose landmarks get lost in that pass keeps its fit to landmarks and is not `improved`.

    Args:
        problem: The sequences, and how they are fitted.
        fit: The fit to landmarks, or that of the schedule `fast`.
        refined: `fit` with texture and light, if it was fitted to pixels.
        known: The result for other sequences of the person. Then only motion is fitted, each frame from its own
            landmarks; subject, cameras, texture and light stay. `refined` has the cameras and lights to keep, and the
            bias of its subject is without the effect of vertex offsets.
    """
    if refined is not None and not (refined.texture.trust > 0).any():
        return refined  # The pictures show nothing to fit to.
    if refined is not None and known is not None:
        fit = replace(fit, subject=replace(fit.subject, identity=known.fit.subject.identity))
        refined = replace(refined, fit=fit, texture=known.texture)
    scene = paper_scene(problem, fit, refined)
    descent = Descent(scene, first_state(scene, fit, refined), fixed_person=known is not None)
    if known is not None:
        state = descent.state
        state.visibility = torch.ones_like(state.visibility)  # The texture's trust is in the scene's weights.
        if known.fit.subject.vertex_offsets is not None:
            state.offsets = known.fit.subject.vertex_offsets.clone()
    descent.resume(problem.cache)
    if problem.settings.paper.start == "fast":
        descent.done = max(descent.done, descent.frames)

    def outcome() -> PhotometricFit:
        moved = _as_photometric(scene, descent, fit, refined)
        if known is None or refined is None:
            return moved
        fixed = replace(moved.fit, subject=known.fit.subject)
        return replace(moved, fit=fixed, texture=known.texture, lights=refined.lights)

    title = "Refining by descent" if known is None else "Refining held-out sequences by descent"
    total = descent.frames * (1 + problem.settings.paper.epochs)
    done = min(descent.done, total)
    with torch.enable_grad(), show_progress(title, "pixels", total, problem.callback, done) as progress:
        advance = partial(progress.advance, current=outcome)
        for sequence in range(len(problem.data)):
            fit_sequence(descent, sequence, advance, problem.cache)
        if descent.done == descent.frames and known is None:
            measure_visibility(descent, some_frames(descent))
            if refined is not None:
                fit_appearance(descent)
        for epoch in range(problem.settings.paper.epochs):
            descent.fit_epoch(epoch, advance, problem.cache)
    return outcome()


def _as_photometric(scene: PaperScene, descent: Descent, fit: Fit, refined: PhotometricFit | None) -> PhotometricFit:
    """The fit with texture and light. Each texel has the trust of its triangle."""
    state = descent.state
    with torch.no_grad():
        # The effect of the offsets on landmarks is added to the bias.
        marks = scene.face_model.landmarks["mediapipe"]
        bias = fit.subject.bias + marks.positions(state.offsets, scene.mesh.faces).double()
    subject = replace(fit.subject, identity=state.identity.double(), bias=bias, vertex_offsets=state.offsets)
    sequences = []
    for own, was, rows in zip(scene.sequences, fit.sequences, state.frames, strict=True):
        factor = 1.0 if own.lens is None else float(state.log_focals[own.lens].exp())
        sequences.append(replace(was, cameras=was.cameras.with_focal(factor), state=rows.double()))
    fragments = texture_space(scene.face_model, scene.settings.texture_size).fragments
    trust = torch.cat([descent.trusted(), torch.zeros(1)])[fragments.face_index.long()]
    improved = [torch.ones(len(rows), dtype=torch.bool) for rows in state.frames]
    if refined is not None:
        improved = [rows.clone() for rows in refined.improved]
    for sequence, row in descent.lost:
        improved[sequence][row] = False
    appearance = SkinTexture(state.texture, trust, COLOR_EPSILON)
    return PhotometricFit(Fit(subject, tuple(sequences)), appearance, tuple(state.lights), tuple(improved))


def fit_appearance(descent: Descent) -> None:
    """Fit texture and light again, all else fixed, to frames spread over the sequences, in random order."""
    chosen, moments, weights = some_frames(descent), {}, descent.trusted()
    order = np.random.default_rng(11).permutation(np.repeat(np.arange(len(chosen)), 6))  # steps at each
    for number, index in enumerate(order):
        targets = descent.targets(*chosen[index])
        moving, leaves = descent.moving(targets[0], ("texture", "light"))
        vertices = pose_vertices(descent.scene, moving)
        colors = [color_term(descent.scene, one, moving, vertices, weights) for one in targets]
        gradients = _gradients(torch.stack(colors).mean() + light_term(moving.light), leaves)
        _step(descent, targets[0].sequence, gradients, moments, _fading(number, len(order)))


def _gradients(cost: Tensor, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    return dict(zip(leaves, torch.autograd.grad(cost, list(leaves.values())), strict=True))


@torch.no_grad()
def _step(
    descent: Descent, sequence: int, gradients: dict[str, Tensor], moments: dict[str, Moments], rate: float
) -> None:
    """Move parameters that frames share, and the light of a sequence, by Adam."""
    for name, gradient in gradients.items():
        light = name == "light"
        values = descent.state.lights[sequence] if light else getattr(descent.state, name)
        own = moments.setdefault(f"light_{sequence}" if light else name, Moments.zeros(values))
        whole = gradient + roughness_gradient(values) if name == "texture" else gradient
        apply_adam(own, values, whole, rate * RATES["lights" if light else name])


def measure_visibility(descent: Descent, places: Sequence[tuple[int, int]]) -> None:
    """Measure how frontally the frames see each triangle, and keep the best in the state."""
    for sequence, row in places:
        for target in descent.targets(sequence, row):
            visibility = visibility_of(descent.scene, target, descent.moving(target, ())[0])
            descent.state.visibility = torch.maximum(descent.state.visibility, visibility)


def some_frames(descent: Descent) -> list[tuple[int, int]]:
    """Frames that are spread over the sequences, as sequence and row."""
    chosen = []
    for sequence, rows in enumerate(descent.state.frames):
        count = min(len(rows), _TEXTURE_FRAMES)
        several = torch.linspace(0, len(rows) - 1, count).round().long().unique()
        chosen += [(sequence, row) for row in several.tolist()]
    return chosen


def fit_sequence(descent: Descent, sequence: int, advance: Advance, cache: StageCache) -> None:
    """Fit the first frame to convergence, then each next from the one before, or from its own if only frames move."""
    rows, start = descent.state.frames[sequence], descent.start[sequence]
    before = sum(len(own) for own in descent.state.frames[:sequence])
    for row in range(max(descent.done - before, 0), len(rows)):
        targets = descent.targets(sequence, row)
        if row == 0 and not descent.fixed_person:
            fit_first(descent, targets, first_of_all=sequence == 0)
            measure_visibility(descent, [(sequence, 0)])
        else:
            if not descent.fixed_person:
                rows[row] = rows[row - 1]
            fit_row(descent, targets, descent.scene.settings.steps)
            if _is_lost(descent, targets[0]):
                rows[row] = start[row]
                descent.lost.append((sequence, row))
        descent.done += 1
        advance(status=f"frame {row + 1} of {len(rows)}")
        descent.offer(cache)


@torch.no_grad()
def _is_lost(descent: Descent, target: Target) -> bool:
    """Whether the landmarks' cost is far worse than in their own fit."""
    scene, moving = descent.scene, descent.moving(target, ())[0]
    start = descent.start[target.sequence][target.row]
    now, then = (float(landmark_terms(scene, target, at)) for at in (moving, replace(moving, row=start)))
    weight = float(scene.sequences[target.sequence].terms[target.row].weights.sum())
    return now - then > _LOST_LANDMARKS**2 * weight


def fit_first(descent: Descent, targets: Sequence[Target], first_of_all: bool) -> None:
    """Fit the first frame of a sequence. The very first one has turns until its cost no longer falls."""
    settings = descent.scene.settings
    if not first_of_all:
        turn_of_first(descent, targets, settings.first_steps // 5, appearance_first=True)
        return
    face = face_of(descent.scene, descent.moving(targets[0], ())[0])
    cameras = [descent.scene.camera(one.sequence, one.camera, descent.state.log_focals) for one in targets]
    frontal = targets[most_frontal_camera(cameras, face)]
    guess_texture(descent.scene, frontal, descent.moving(frontal, ())[0], descent.state.texture)
    before, cost = math.inf, turn_of_first(descent, targets, settings.first_steps, appearance_first=True)
    while cost < (1 - _FIRST_CONVERGED) * before:
        before, cost = cost, turn_of_first(descent, targets, settings.first_steps, appearance_first=False)


def turn_of_first(descent: Descent, targets: Sequence[Target], steps: int, appearance_first: bool) -> float:
    """Fit all parameters to a first frame, and return the mean cost of the last tenth of the steps.

    With `appearance_first`, only texture and light move in the first half of them.
    """
    scene, target, costs, moments = descent.scene, targets[0], [], {}
    lenses = ("log_focals",) if len(descent.state.log_focals) else ()
    stepper = descent.stepper(target.sequence, target.row, smoothness=0.0)
    for step in range(steps):
        names = () if appearance_first and 2 * step < steps else ("row", "identity", "offsets", *lenses)
        moving, leaves = descent.moving(target, ("texture", "light", *names))
        cost = descent.frame_cost(targets, moving, scene.used, None) + shared_terms(scene, moving, [moving.light])
        gradients, rate = _gradients(cost, leaves), _fading(step, steps)
        costs.append(float(cost.detach()))
        if names:
            stepper.step(gradients.pop("row"), rate * RATES["row"])
        _step(descent, target.sequence, gradients, moments, rate)
    last = costs[-max(1, steps // 10) :]
    return sum(last) / max(len(last), 1)


def fit_row(descent: Descent, targets: Sequence[Target], steps: int) -> None:
    """Fit the pose and expression of a frame, all else fixed."""
    sequence, row = targets[0].sequence, targets[0].row
    smoothness = descent.scene.settings.pass_smoothness
    stepper = descent.stepper(sequence, row, smoothness=0.0)  # Shorter steps could not follow from the frame before.
    weights, even, around = descent.trusted(), list(targets), descent.state.frames[sequence][: row + 1]
    for step in range(steps):
        moving, leaves = descent.moving(targets[0], ("row",))
        if step % 10 == 0:  # number of a frame's steps between estimates of the unexplained light in its pictures
            even = [without_smooth_difference(descent.scene, target, moving, weights) for target in targets]
        gradients = _gradients(descent.frame_cost(even, moving, weights, around, smoothness), leaves)
        stepper.step(gradients["row"], RATES["row"] * _fading(step, steps))


def _fading(step: int, steps: int) -> float:
    """Factor of the learning rate at a step."""
    return 1 - (1 - _LAST_RATE) * step / max(steps - 1, 1)
