"""The global epochs of the `paper` schedule, Adam's updates, and the state that all its steps share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.adam import BETA1, BETA2, Moments
from mien.machine.parallel import map_in_threads
from mien.machine.progress import Advance
from mien.tracking.descent.scene import PaperScene, PaperState
from mien.tracking.descent.terms import (
    Moving,
    Target,
    color_term,
    landmark_terms,
    pose_vertices,
    prior_term,
    read_target,
    roughness_gradient,
    shared_terms,
    smoothness_term,
    without_smooth_difference,
)
from mien.tracking.fitting.resume import StageCache
from mien.tracking.fitting.solver import Bounds

_GLOBAL_RATE = 0.1  # factor of the initial learning rates in the first epoch
_EPOCH_DECAY = 0.9  # factor of the learning rates from one epoch to the next
_GOOD_COSINE = 0.5  # least cosine of the viewing angle at which a triangle's texels count fully
MOST_BATCHES = 40  # largest number of batches in an epoch
_TEXTURE_EVERY = 4  # fewest frames whose texture gradients are summed for one step

RATES = {"row": 0.3, "identity": 1e-2, "offsets": 1e-4, "texture": 1e-2, "lights": 5e-3, "log_focals": 1e-3}
"""Learning rates of Adam at the start of a fit; offsets are in metres. That of a frame's own parameters is in standard
deviations that its landmarks leave, so that head rotation and translation, or two expressions that look alike, do not
hinder each other."""
_SETTLED_GRADIENT = 2.0
"""Gradient of a squared cost at one standard deviation; it damps steps with smaller gradients. Plain Adam moves by its
whole rate however small the gradient is. Measured against none: jitter falls from 0.034 to 0.014 mm (log)."""
_AT_ONCE = 16
"""Number of frames of a batch whose gradients are in memory together, about 60 MB."""


def apply_adam(moments: Moments, values: Tensor, gradient: Tensor, rate: float, settled: float = 1e-12) -> None:
    """Move the values in place by Adam (Kingma and Ba 2015). At the gradient `settled` a step is half of `rate`."""
    moments.step += 1
    count = int(moments.step)
    moments.first.lerp_(gradient, 1 - BETA1)
    moments.second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    root = (moments.second / (1 - BETA2**count)).sqrt_().add_(settled)
    moved = moments.first / root
    values.sub_(moved.mul_(rate).mul_(1 / (1 - BETA1**count)))


@dataclass(frozen=True, eq=False)
class RowStepper:
    """Moves a timestep's parameters by Adam, in coordinates that landmarks determine equally well."""

    row: Float[Tensor, " p"]
    """The parameters, which are moved in place."""
    whitening: Float[Tensor, "p p"]
    """Transform to parameters from independent coordinates in units of the standard deviations left by landmarks."""
    moments: Moments
    bounds: Bounds

    @torch.no_grad()
    def step(self, gradient: Float[Tensor, " p"], rate: float) -> None:
        """Take one step of at most about `rate` standard deviations and clip to the bounds."""
        move = torch.zeros_like(self.row)
        apply_adam(self.moments, move, gradient @ self.whitening, rate, _SETTLED_GRADIENT)
        self.row.add_(self.whitening @ move)
        self.row.copy_(self.bounds.clip(self.row))


class Descent:
    """A fit in progress: the parameters and the state of their optimisers. Mutable."""

    def __init__(self, scene: PaperScene, state: PaperState, fixed_person: bool = False) -> None:
        self.scene, self.state = scene, state
        self.fixed_person = fixed_person
        """Whether only the frames' own parameters move."""
        self.bounds = Bounds(scene.layout.lower.float(), scene.layout.upper.float())
        self.start = [rows.clone() for rows in state.frames]
        """The frames' parameters at the start."""
        self.frames = sum(len(rows) for rows in state.frames)
        self.done = 0
        """Number of frames done, over the pass along the frames and all epochs."""
        self.lost: list[tuple[int, int]] = []
        self._steppers: dict[tuple[int, int], RowStepper] = {}
        self._moments: dict[str, Moments] = {}

    def resume(self, cache: StageCache) -> None:
        """Resume from the state that a cache holds, if any."""
        tensors = cache.read("descent")
        if tensors is None:
            return
        for name, tensor in self.state.tensors().items():
            tensor.copy_(tensors[name])
        self.done, self.lost = int(tensors["done"]), [(int(s), int(row)) for s, row in tensors["lost"]]
        for name in [key.removesuffix("/first") for key in tensors if key.endswith("/first")]:
            first, second, count = (tensors[f"{name}/{part}"] for part in ("first", "second", "count"))
            moments, (kind, *place) = Moments(first, second, count.to(first.dtype)), name.split("/")
            if kind == "moments":
                self._moments[place[0]] = moments
            else:
                sequence, row = (int(part) for part in place)
                values, whitening = self.state.frames[sequence][row], tensors[f"{name}/whitening"]
                self._steppers[sequence, row] = RowStepper(values, whitening, moments, self.bounds)

    def offer(self, cache: StageCache) -> None:
        """Offer the present state to the cache, which stores it if it is time."""
        cache.offer("descent", self._packed)

    def _packed(self) -> dict[str, Tensor]:
        """The complete state as tensors by name."""
        tensors = self.state.tensors() | {"done": torch.tensor([self.done])}
        tensors["lost"] = torch.tensor(self.lost).reshape(-1, 2)
        steppers = {f"rows/{sequence}/{row}": stepper for (sequence, row), stepper in self._steppers.items()}
        every = {f"moments/{name}": moments for name, moments in self._moments.items()}
        for name, own in (every | {name: stepper.moments for name, stepper in steppers.items()}).items():
            tensors |= {f"{name}/first": own.first, f"{name}/second": own.second, f"{name}/count": own.step.long()}
        return tensors | {f"{name}/whitening": stepper.whitening for name, stepper in steppers.items()}

    def fit_epoch(self, epoch: int, advance: Advance, cache: StageCache) -> None:
        """Take one step of every frame in random order. Each batch of frames also moves the shared parameters."""
        if self.done >= self.frames * (2 + epoch):
            return
        places = [(sequence, row) for sequence, rows in enumerate(self.state.frames) for row in range(len(rows))]
        order = np.random.default_rng((7, epoch)).permutation(len(places))
        batches = np.array_split(order, min(MOST_BATCHES, len(places)))
        scale = _GLOBAL_RATE * _EPOCH_DECAY**epoch
        texture_gradient, seen = torch.zeros_like(self.state.texture), 0
        for batch in batches:
            gradients = self._step_frames([places[index] for index in batch], scale)
            if not self.fixed_person:
                texture_gradient, seen = texture_gradient + gradients.pop("texture"), seen + len(batch)
                self._step_shared(gradients, scale, 1 / len(batches), len(batch))
            if seen >= _TEXTURE_EVERY:
                mean = texture_gradient / seen + roughness_gradient(self.state.texture) / _TEXTURE_EVERY
                self._step("texture", mean, scale)
                texture_gradient, seen = torch.zeros_like(texture_gradient), 0
            advance(len(batch), status=f"epoch {epoch + 1}")
        self.done += self.frames
        self.offer(cache)

    def _step_frames(self, batch: Sequence[tuple[int, int]], scale: float) -> dict[str, Tensor]:
        """Move each frame's own parameters and return the summed gradients of the shared parameters."""
        weights, total = self.trusted(), {}
        for some in (batch[start : start + _AT_ONCE] for start in range(0, len(batch), _AT_ONCE)):
            for place, gradients in zip(some, map_in_threads(partial(self._gradients, weights), some), strict=True):
                if place not in self._steppers:
                    self._steppers[place] = self.stepper(*place)
                self._steppers[place].step(gradients.pop("row"), scale * RATES["row"])
                if not self.fixed_person:
                    gradients["lights"] = torch.zeros_like(self.state.lights)
                    gradients["lights"][place[0]] = gradients.pop("light")
                for name, gradient in gradients.items():
                    total[name] = total[name] + gradient if name in total else gradient
        return total

    def _gradients(self, weights: Float[Tensor, " f"], place: tuple[int, int]) -> dict[str, Tensor]:
        """Gradients of one timestep's cost by all parameters that it depends on and that move."""
        names = ["row"]
        if not self.fixed_person:
            names += ["identity", "texture", "light", "offsets"]
            names += ["log_focals"] if len(self.state.log_focals) else []
        targets = self.targets(*place)
        with torch.enable_grad():
            moving, leaves = self.moving(targets[0], names)
            targets = [without_smooth_difference(self.scene, target, moving, weights) for target in targets]
            cost = self.frame_cost(targets, moving, weights, self.state.frames[place[0]])
            gradients = torch.autograd.grad(cost, list(leaves.values()), allow_unused=True, materialize_grads=True)
        return dict(zip(leaves, gradients, strict=True))

    def _step_shared(self, gradients: dict[str, Tensor], scale: float, share: float, frames: int) -> None:
        """Move the shared parameters by a batch's summed gradients and its share of the priors' gradients."""
        leaves = {name: getattr(self.state, name).clone().requires_grad_() for name in gradients}
        with torch.enable_grad():
            state = replace(self.state, **leaves)
            cost = shared_terms(self.scene, state, state.lights)
            by_prior = torch.autograd.grad(cost, list(leaves.values()))
        for (name, gradient), beforehand in zip(gradients.items(), by_prior, strict=True):
            mean = gradient / frames + share * beforehand
            self._step(name, mean * self.scene.offset_share if name == "offsets" else mean, scale)

    def _step(self, name: str, gradient: Tensor, scale: float) -> None:
        value = getattr(self.state, name)
        with torch.no_grad():
            moments = self._moments.setdefault(name, Moments.zeros(value))
            apply_adam(moments, value, gradient, scale * RATES[name])

    def frame_cost(
        self,
        targets: Sequence[Target],
        moving: Moving,
        weights: Float[Tensor, " f"],
        around: Float[Tensor, "t p"] | None,
        smoothness: float = 1.0,
    ) -> Float[Tensor, ""]:
        """The cost of a timestep: the mean of its pictures' colours, landmarks, prior, and smoothness.

        `around` are the rows of the sequence, of which those around the timestep count for smoothness; None leaves it
        out. The past alone would continue steady motion against the pictures.
        """
        scene, own = self.scene, targets[0]
        vertices = pose_vertices(scene, moving)
        colors = [color_term(scene, target, moving, vertices, weights) for target in targets]
        cost = torch.stack(colors).mean() + landmark_terms(scene, own, moving) + prior_term(scene, moving.row)
        if around is None or smoothness == 0:
            return cost
        return cost + smoothness * smoothness_term(scene.sequences[own.sequence], around, own.row, moving.row)

    def moving(self, target: Target, names: Sequence[str]) -> tuple[Moving, dict[str, Tensor]]:
        """The parameters for a picture, and those in `names` as leaves for gradients."""
        state = self.state
        values = {"row": state.frames[target.sequence][target.row], "light": state.lights[target.sequence]}
        values |= {name: getattr(state, name) for name in ("identity", "offsets", "texture", "log_focals")}
        leaves = {name: values[name].detach().clone().requires_grad_() for name in names}
        return Moving(**(values | leaves)), leaves

    def stepper(self, sequence: int, row: int, smoothness: float = 1.0) -> RowStepper:
        """A new stepper for a timestep's parameters, whose cost has smoothness by this factor."""
        values = self.state.frames[sequence][row]
        linked = torch.cat([torch.zeros(1), self.scene.sequences[sequence].smoothness.linked, torch.zeros(1)])
        around = linked[row : row + 3] * (smoothness * torch.tensor([1.0, 4.0, 1.0]))
        whitening = self.scene.whitening(sequence, row, values, float(around.sum()))
        return RowStepper(values, whitening, Moments.zeros(values), self.bounds)

    def targets(self, sequence: int, row: int) -> list[Target]:
        """The pictures of a timestep in all cameras that found a face in it."""
        return [read_target(self.scene, sequence, row, camera) for camera in self.cameras(sequence, row)]

    def cameras(self, sequence: int, row: int) -> list[int]:
        """The cameras that found a face at a timestep."""
        return self.scene.sequences[sequence].seen_by(row)

    def trusted(self) -> Float[Tensor, " f"]:
        """Weight of the texels of each triangle, 0..1, by how frontally the triangle was seen."""
        return self.scene.used * (self.state.visibility / _GOOD_COSINE).clamp_max(1.0)
