"""The steps before the global epochs of the `paper` schedule: the pass along the frames, then texture and light."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from mien.progress import Advance
from mien.tracking.descent.adam import Moments
from mien.tracking.descent.epochs import Descent
from mien.tracking.descent.terms import (
    Shown,
    color_term,
    guess_texture,
    landmark_terms,
    light_term,
    posed,
    roughness_gradient,
    show,
    sight_of,
    without_smooth_difference,
)
from mien.tracking.fitting import Keeper

_LAST_RATE = 0.1
"""Factor of the learning rates at the last of a frame's steps."""
_BETTER_SIGHT = 0.15
"""A frame must see a triangle more frontally than earlier frames by this cosine for its texels to be learned again."""
_LEAST_COSINE = 0.1
_TEXTURE_FRAMES, _TEXTURE_ROUNDS = 40, 6
"""Frames of each sequence, and steps at each, from which texture and light are fitted before the epochs."""
_LOST = 3.0
"""Landmarks are lost if they are farther off than in their own fit by more than this many standard deviations."""
_LIGHT_EVERY = 10
"""Steps between estimates of the unexplained light of a picture."""
_OTHER_FIRST = 5
"""The first frames of further sequences get the first frame's number of steps divided by this."""


def fit_looks(descent: Descent) -> None:
    """Fit texture and light again, all else fixed, to frames spread over the sequences, in random order."""
    chosen = _some_frames(descent)
    moments: dict[str, Moments] = {}
    order = np.random.default_rng(11).permutation(np.repeat(np.arange(len(chosen)), _TEXTURE_ROUNDS))
    for number, index in enumerate(order):
        sequence, row = chosen[index]
        cameras = descent.cameras(sequence, row)
        shown = show(descent.scene, sequence, row, cameras[number % len(cameras)])
        _step_looks(descent, shown, moments, _fading(number, len(order)))


def look_around(descent: Descent) -> None:
    """Measure how frontally the frames see each triangle, and keep the best in the state."""
    for sequence, row in _some_frames(descent):
        for camera in descent.cameras(sequence, row):
            shown = show(descent.scene, sequence, row, camera)
            sight = sight_of(descent.scene, shown, descent.moving(shown, ())[0])
            descent.state.sight = torch.maximum(descent.state.sight, sight)


def _some_frames(descent: Descent) -> list[tuple[int, int]]:
    chosen = []
    for sequence, rows in enumerate(descent.state.frames):
        several = torch.linspace(0, len(rows) - 1, min(len(rows), _TEXTURE_FRAMES)).round().long().unique()
        chosen += [(sequence, row) for row in several.tolist()]
    return chosen


def _step_looks(descent: Descent, shown: Shown, moments: dict[str, Moments], rate: float) -> None:
    scene, state = descent.scene, descent.state
    moving, leaves = descent.moving(shown, ("texture", "light"))
    vertices, _ = posed(scene, moving)
    loss = color_term(scene, shown, moving, vertices, descent.trusted()) + light_term(scene, moving.light)
    by_texture, by_light = torch.autograd.grad(loss, list(leaves.values()))
    rates, light = scene.settings.rates, state.lights[shown.sequence]
    with torch.no_grad():
        by_texture += roughness_gradient(scene, state.texture)
        of_texture = moments.setdefault("texture", Moments.like(by_texture))
        of_texture.step(state.texture, by_texture, rate * rates.texture)
        of_light = moments.setdefault(f"light_{shown.sequence}", Moments.like(light))
        of_light.step(light, by_light, rate * rates.light)


def fit_sequence(descent: Descent, sequence: int, advance: Advance, keeper: Keeper) -> None:
    """Fit the first frame to convergence, then each next frame from the one before it, moved as its landmarks moved."""
    rows, start = descent.state.frames[sequence], descent.start[sequence]
    before = sum(len(own) for own in descent.state.frames[:sequence])
    for row in range(max(descent.done - before, 0), len(rows)):
        shown = [show(descent.scene, sequence, row, camera) for camera in descent.cameras(sequence, row)]
        if row == 0:
            _fit_first(descent, shown[0], first_of_all=sequence == 0)
        else:
            rows[row] = descent.within(rows[row - 1] + start[row] - start[row - 1])
            _fit_row(descent, shown, descent.scene.settings.steps)
            if _is_lost(descent, shown[0]):
                rows[row] = start[row]
                descent.lost.append((sequence, row))
        for one in shown:
            _learn_texture(descent, one)
        descent.done += 1
        advance(status=f"frame {row + 1} of {len(rows)}")
        descent.offer(keeper)


def recentre(descent: Descent) -> None:
    """Remove the error that all frames inherited from the first frame.

    Each frame was fitted to a texture that started from the first frame with the errors of its landmarks. The median
    difference from the fit to landmarks over all frames is that error, because the errors of all landmarks average out.
    """
    for rows, was in zip(descent.state.frames, descent.start, strict=True):
        rows.copy_(descent.within(rows + (was - rows).median(0).values))


@torch.no_grad()
def _is_lost(descent: Descent, shown: Shown) -> bool:
    """Whether the landmarks' cost is far worse than in their own fit."""
    scene, moving = descent.scene, descent.moving(shown, ())[0]
    start = descent.start[shown.sequence][shown.row]
    now, then = (float(landmark_terms(scene, shown, at)) for at in (moving, replace(moving, row=start)))
    return now - then > _LOST**2 * float(scene.sequences[shown.sequence].terms[shown.row].weights.sum())


def _fit_first(descent: Descent, shown: Shown, first_of_all: bool) -> None:
    scene = descent.scene
    settings, weights = scene.settings, scene.used
    if first_of_all:
        guess_texture(scene, shown, descent.moving(shown, ())[0], descent.state.texture)
    steps = settings.first_steps if first_of_all else settings.first_steps // _OTHER_FIRST
    looks = {"texture": descent.state.texture, "light": descent.state.lights[shown.sequence]}
    moments = {name: Moments.like(value) for name, value in looks.items()}
    stepper = descent.stepper(shown.sequence, shown.row, past_only=True)
    for step in range(steps):
        rate = _fading(step, steps)
        names = ("row", "texture", "light") if 2 * step >= steps else ("texture", "light")
        moving, leaves = descent.moving(shown, names)
        loss = descent.frame_cost(shown, moving, weights, past_only=True) + light_term(scene, moving.light)
        gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
        with torch.no_grad():
            gradients["texture"] = gradients["texture"] + roughness_gradient(scene, moving.texture)
            for name, value in looks.items():
                moments[name].step(value, gradients[name], rate * getattr(settings.rates, name))
            if "row" in leaves:
                stepper.step(gradients["row"], rate * settings.rates.frame)


def _fit_row(descent: Descent, shown: Sequence[Shown], steps: int) -> None:
    rate, stepper = descent.scene.settings.rates.frame, descent.stepper(shown[0].sequence, shown[0].row, past_only=True)
    weights, even = descent.trusted(), list(shown)
    for step in range(steps):
        index = step % len(shown)
        moving, leaves = descent.moving(shown[index], ("row",))
        if step % (_LIGHT_EVERY * len(shown)) < len(shown):
            even[index] = without_smooth_difference(descent.scene, shown[index], moving, weights)
        loss = descent.frame_cost(even[index], moving, weights, past_only=True)
        (gradient,) = torch.autograd.grad(loss, list(leaves.values()))
        stepper.step(gradient, rate * _fading(step, steps))


def _learn_texture(descent: Descent, shown: Shown) -> None:
    """Learn the texels of triangles that this frame shows more frontally than the frames before it."""
    scene, state = descent.scene, descent.state
    with torch.no_grad():
        sight = sight_of(scene, shown, descent.moving(shown, ())[0])
        better = (sight > state.sight + _BETTER_SIGHT) & (sight > _LEAST_COSINE)
    if shown.row > 0 and better.any():
        moments, steps = Moments.like(state.texture), scene.settings.texture_steps
        for step in range(steps):
            moving, leaves = descent.moving(shown, ("texture",))
            vertices, _ = posed(scene, moving)
            loss = color_term(scene, shown, moving, vertices, scene.used * better)
            (gradient,) = torch.autograd.grad(loss, list(leaves.values()))
            moments.step(state.texture, gradient, 3 * scene.settings.rates.texture * _fading(step, steps))
    seen = sight > _LEAST_COSINE
    state.sight = torch.where(better | (seen & (state.sight == 0)), sight, state.sight)


def _fading(step: int, steps: int) -> float:
    """Factor of the learning rate at a step."""
    return 1 - (1 - _LAST_RATE) * step / max(steps - 1, 1)
