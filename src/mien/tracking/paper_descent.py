"""The steps of the `paper` schedule, and what they remember."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.progress import Advance
from mien.tracking.paper_adam import Moments, RowStepper
from mien.tracking.paper_looks import guess_texture, roughness_gradient, sight_of
from mien.tracking.paper_scene import PaperScene, PaperState
from mien.tracking.paper_state import pack, unpack_moments, unpack_state
from mien.tracking.paper_terms import (
    Moving,
    Shown,
    color_term,
    landmark_terms,
    light_term,
    posed,
    prior_term,
    shared_terms,
    show,
    smoothness_term,
    without_smooth_difference,
)
from mien.tracking.resume import Keeper
from mien.tracking.stages import Fit

_PIECE = "descent"
_GLOBAL_RATE, _EPOCH_DECAY = 0.1, 0.9
"""Of the first rates in the first epoch, and from one to the next."""
_LAST_RATE = 0.1
"""Of the first rates at the last of a frame's steps."""
_GOOD_COSINE = 0.5
"""Of triangles seen less frontally, texels count in proportion."""
_BETTER_SIGHT = 0.15
"""By this much a frame must see a triangle more frontally than those before, to have its texels learned anew."""
_LEAST_COSINE = 0.1
_TEXTURE_EVERY = 4
"""Global steps whose gradients by the texture are taken together: a step of all texels costs as much as a picture."""
_TEXTURE_FRAMES, _TEXTURE_ROUNDS = 40, 6
"""Frames of each sequence, and steps at each, from which texture and light are made anew before the epochs."""
_LOST = 3.0
"""Standard deviations by which landmarks may be farther off than where they were fitted alone."""
_LIGHT_EVERY = 10
"""Steps between looks at what of a picture is light."""
_OTHER_FIRST = 5
"""Part of the first frame's steps that the first frames of further sequences get."""


class Descent:
    """A fit on its way: the parameters and what Adam knows of them."""

    def __init__(self, scene: PaperScene, state: PaperState, fit: Fit) -> None:
        self.scene, self.state = scene, state
        self.frames = sum(len(rows) for rows in state.frames)
        self.done = 0
        """Frames, those of past epochs as well."""
        self.lost: list[tuple[int, int]] = []
        self._by_landmarks = [own.state.float() for own in fit.sequences]
        self._steppers: dict[tuple[int, int], RowStepper] = {}
        self._moments: dict[str, Moments] = {}
        self._texture_gradient: Tensor | None = None

    def resume(self, keeper: Keeper) -> None:
        """Go on from what a keeper has."""
        tensors = keeper.read(_PIECE)
        if tensors is None:
            return
        unpack_state(self.state, tensors)
        self.done, self.lost = int(tensors["done"]), [(int(s), int(row)) for s, row in tensors["lost"]]
        self._moments = unpack_moments(tensors, "moments/")
        for name, moments in unpack_moments(
            {k: v for k, v in tensors.items() if k.startswith("rows/")}, "rows/"
        ).items():
            sequence, row = (int(part) for part in name.split("/"))
            stepper = self._stepper(sequence, row, past_only=False)
            self._steppers[sequence, row] = replace(
                stepper, whitening=tensors[f"rows/{name}/whitening"], moments=moments
            )

    def _pack(self) -> dict[str, Tensor]:
        return pack(self.state, self._moments, self._steppers, self.lost, self.done)

    # One sequence, forward in time.

    def fit_sequence(self, sequence: int, advance: Advance, keeper: Keeper) -> None:
        """The first frame to convergence, then each next frame from the one before it, moved as its landmarks did."""
        rows, by_landmarks = self.state.frames[sequence], self._by_landmarks[sequence]
        before = sum(len(own) for own in self.state.frames[:sequence])
        for row in range(max(self.done - before, 0), len(rows)):
            shown = [show(self.scene, sequence, row, camera) for camera in self._cameras(sequence, row)]
            if row == 0:
                self._fit_first(shown[0], first_of_all=sequence == 0)
            else:
                rows[row] = self._within(rows[row - 1] + by_landmarks[row] - by_landmarks[row - 1])
                self._fit_row(shown, self.scene.settings.steps)
                if self._is_lost(shown[0], by_landmarks[row]):
                    rows[row] = by_landmarks[row]
                    self.lost.append((sequence, row))
            for one in shown:
                self._learn_texture(one)
            self.done += 1
            advance(status=f"frame {row + 1} of {len(rows)}")
            keeper.offer(_PIECE, self._pack)

    @torch.no_grad()
    def _is_lost(self, shown: Shown, by_landmarks: Float[Tensor, " p"]) -> bool:
        """Whether landmarks are far worse off than where they were fitted alone."""
        moving, _ = self._moving(shown, ())
        now, then = (float(landmark_terms(self.scene, shown, at)) for at in (moving, replace(moving, row=by_landmarks)))
        return now - then > _LOST**2 * float(self.scene.sequences[shown.sequence].terms[shown.row].weights.sum())

    def _fit_first(self, shown: Shown, first_of_all: bool) -> None:
        settings = self.scene.settings
        if first_of_all:
            guess_texture(self.scene, shown, self._moving(shown, ())[0], self.state.texture)
        steps = settings.first_steps if first_of_all else settings.first_steps // _OTHER_FIRST
        moments = {name: Moments.like(value) for name, value in self._leaves(shown.sequence).items()}
        stepper = self._stepper(shown.sequence, shown.row)
        weights = self.scene.used
        for step in range(steps):
            rate = _fading(step, steps)
            moving, leaves = self._moving(
                shown, ("row", "texture", "light") if 2 * step >= steps else ("texture", "light")
            )
            loss = self._frame_cost(shown, moving, weights, past_only=True) + light_term(self.scene, moving.light)
            gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
            with torch.no_grad():
                for name in ("texture", "light"):
                    own = (
                        gradients[name] + roughness_gradient(self.scene, moving.texture)
                        if name == "texture"
                        else gradients[name]
                    )
                    moments[name].step(self._value(name, shown.sequence), own, rate * getattr(settings.rates, name))
                if "row" in leaves:
                    stepper.step(gradients["row"], rate)

    def _fit_row(self, shown: Sequence[Shown], steps: int) -> None:
        stepper, weights = self._stepper(shown[0].sequence, shown[0].row), self.trusted()
        even = list(shown)
        for step in range(steps):
            index = step % len(shown)
            moving, leaves = self._moving(shown[index], ("row",))
            if step % (_LIGHT_EVERY * len(shown)) < len(shown):
                even[index] = without_smooth_difference(self.scene, shown[index], moving, weights)
            one = even[index]
            loss = self._frame_cost(one, moving, weights, past_only=True)
            (gradient,) = torch.autograd.grad(loss, list(leaves.values()))
            stepper.step(gradient, _fading(step, steps))

    def _learn_texture(self, shown: Shown) -> None:
        """Texels of triangles that this frame shows better than those before it."""
        with torch.no_grad():
            moving, _ = self._moving(shown, ())
            sight = sight_of(self.scene, shown, moving)
            better = (sight > self.state.sight + _BETTER_SIGHT) & (sight > _LEAST_COSINE)
        if shown.row > 0 and better.any():
            moments = Moments.like(self.state.texture)
            steps = self.scene.settings.texture_steps
            for step in range(steps):
                moving, leaves = self._moving(shown, ("texture",))
                vertices, _ = posed(self.scene, moving)
                loss = color_term(self.scene, shown, moving, vertices, self.scene.used * better)
                (gradient,) = torch.autograd.grad(loss, list(leaves.values()))
                moments.step(self.state.texture, gradient, 3 * self.scene.settings.rates.texture * _fading(step, steps))
        seen = sight > _LEAST_COSINE
        self.state.sight = torch.where(better | (seen & (self.state.sight == 0)), sight, self.state.sight)

    # All frames in random order.

    def recentre(self) -> None:
        """What all frames inherited from the first one's error, taken back; and texture and light for that.

        Each frame was fitted to a texture that began with the first one, and with how its landmarks happened to err.
        The middle difference from landmarks over all frames is that error; theirs averages out.
        """
        steps = []
        for sequence, (rows, was) in enumerate(zip(self.state.frames, self._by_landmarks, strict=True)):
            rows.copy_(self._within(rows + (was - rows).median(0).values))
            count = min(len(rows), _TEXTURE_FRAMES)
            chosen = torch.linspace(0, len(rows) - 1, count).round().long().unique().tolist()
            steps += [(sequence, row) for row in chosen]
        moments: dict[str, Moments] = {}
        order = np.random.default_rng(11).permutation(np.repeat(np.arange(len(steps)), _TEXTURE_ROUNDS))
        for number, index in enumerate(order):
            sequence, row = steps[index]
            camera = self._cameras(sequence, row)[number % len(self._cameras(sequence, row))]
            shown = show(self.scene, sequence, row, camera)
            self._step_appearance(shown, moments, _fading(number, len(order)))

    def _cameras(self, sequence: int, row: int) -> list[int]:
        return self.scene.sequences[sequence].seen_by(row)

    def _step_appearance(self, shown: Shown, moments: dict[str, Moments], rate: float) -> None:
        """One step of texture and light alone."""
        moving, leaves = self._moving(shown, ("texture", "light"))
        vertices, _ = posed(self.scene, moving)
        loss = color_term(self.scene, shown, moving, vertices, self.trusted()) + light_term(self.scene, moving.light)
        by_texture, by_light = torch.autograd.grad(loss, list(leaves.values()))
        rates = self.scene.settings.rates
        with torch.no_grad():
            by_texture += roughness_gradient(self.scene, self.state.texture)
            moments.setdefault("texture", Moments.like(by_texture)).step(
                self.state.texture, by_texture, rate * rates.texture
            )
            light = self.state.lights[shown.sequence]
            moments.setdefault(f"light_{shown.sequence}", Moments.like(light)).step(light, by_light, rate * rates.light)

    def fit_epoch(self, epoch: int, advance: Advance, keeper: Keeper) -> None:
        """A step at every frame, which moves what is shared as well."""
        if self.done >= self.frames * (2 + epoch):
            return
        pairs = [(sequence, row) for sequence, rows in enumerate(self.state.frames) for row in range(len(rows))]
        random = np.random.default_rng((7, epoch))
        scale = _GLOBAL_RATE * _EPOCH_DECAY**epoch
        for number, index in enumerate(random.permutation(len(pairs))):
            sequence, row = pairs[index]
            cameras = self._cameras(sequence, row)
            shown = show(self.scene, sequence, row, int(random.choice(cameras)))
            self._global_step(shown, scale, 1 / len(pairs), number % _TEXTURE_EVERY == _TEXTURE_EVERY - 1)
            advance(status=f"epoch {epoch + 1}")
        self._texture_gradient = None
        self.done += self.frames
        keeper.offer(_PIECE, self._pack)

    def _global_step(self, shown: Shown, scale: float, share: float, with_texture: bool) -> None:
        settings = self.scene.settings
        names = ["row", "identity", "texture", "light"]
        names += ["offsets"] if settings.offset_sigma > 0 else []
        names += ["log_focals"] if len(self.state.log_focals) else []
        moving, leaves = self._moving(shown, tuple(names))
        weights = self.trusted()
        shown = without_smooth_difference(self.scene, shown, moving, weights)
        loss = self._frame_cost(shown, moving, weights, past_only=False)
        loss = loss + share * shared_terms(self.scene, moving)
        gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()), allow_unused=True), strict=True))
        key = (shown.sequence, shown.row)
        if key not in self._steppers:
            self._steppers[key] = self._stepper(shown.sequence, shown.row, past_only=False)
        self._steppers[key].step(gradients.pop("row"), scale)
        by_texture = gradients.pop("texture")
        summed = by_texture if self._texture_gradient is None else self._texture_gradient + by_texture
        self._texture_gradient = None if with_texture else summed
        if with_texture:
            gradients["texture"] = summed + roughness_gradient(self.scene, self.state.texture)
        with torch.no_grad():
            for name, gradient in gradients.items():
                if gradient is None:
                    continue
                value = self._value(name, shown.sequence)
                moment_name = f"{name}_{shown.sequence}" if name == "light" else name
                moments = self._moments.setdefault(moment_name, Moments.like(value))
                if name == "offsets":
                    gradient = gradient * self.scene.offset_share
                rate = settings.rates.focal if name == "log_focals" else getattr(settings.rates, name)
                moments.step(value, gradient, scale * rate)

    # What both share.

    def _frame_cost(
        self, shown: Shown, moving: Moving, weights: Float[Tensor, " f"], past_only: bool
    ) -> Float[Tensor, ""]:
        scene = self.scene
        vertices, _ = posed(scene, moving)
        own, rows = scene.sequences[shown.sequence], self.state.frames[shown.sequence]
        cost = color_term(scene, shown, moving, vertices, weights) + landmark_terms(scene, shown, moving)
        cost = cost + prior_term(scene, moving.row)
        # With the past alone, steady motion would go on past what pictures say: heads drifted by degrees.
        return cost if past_only else cost + smoothness_term(own, rows, shown.row, moving.row)

    def _leaves(self, sequence: int) -> dict[str, Tensor]:
        return {name: self._value(name, sequence) for name in ("identity", "offsets", "texture", "light", "log_focals")}

    def _value(self, name: str, sequence: int) -> Tensor:
        return self.state.lights[sequence] if name == "light" else getattr(self.state, name)

    def _moving(self, shown: Shown, names: Sequence[str]) -> tuple[Moving, dict[str, Tensor]]:
        """The parameters at a picture; those named are leaves."""
        values = {"row": self.state.frames[shown.sequence][shown.row], **self._leaves(shown.sequence)}
        leaves = {name: values[name].detach().clone().requires_grad_() for name in names}
        return Moving(**(values | leaves)), leaves

    def _within(self, row: Float[Tensor, "*t p"]) -> Float[Tensor, "*t p"]:
        layout = self.scene.layout
        return torch.minimum(torch.maximum(row, layout.lower.to(row)), layout.upper.to(row))

    def _stepper(self, sequence: int, row: int, past_only: bool = True) -> RowStepper:
        values = self.state.frames[sequence][row]
        layout, rate = self.scene.layout, self.scene.settings.rates.frame
        linked = torch.cat([torch.zeros(1), self.scene.sequences[sequence].smoothness.linked, torch.zeros(1)])
        around = linked[row : row + 3] * torch.tensor([0.0, 0.0, 0.0] if past_only else [1.0, 4.0, 1.0])
        whitening = self.scene.whitening(sequence, row, values, float(around.sum()))
        return RowStepper(values, whitening * rate, Moments.like(values), (layout.lower.float(), layout.upper.float()))

    def trusted(self) -> Float[Tensor, " f"]:
        """How far the texels of each triangle were seen frontally, 0..1."""
        return self.scene.used * (self.state.sight / _GOOD_COSINE).clamp_max(1.0)


def _fading(step: int, steps: int) -> float:
    """Of the first rate at a step."""
    return 1 - (1 - _LAST_RATE) * step / max(steps - 1, 1)
