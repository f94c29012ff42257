"""The global epochs of the `paper` schedule, and the state that all its steps share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.adam import Moments
from mien.machine.parallel import map_in_threads
from mien.machine.progress import Advance
from mien.tracking.descent.adam import RowStepper, apply_adam
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

_GLOBAL_RATE = 0.1  # factor of the initial learning rates in the first epoch
_EPOCH_DECAY = 0.9  # factor of the learning rates from one epoch to the next
_GOOD_COSINE = 0.5  # least cosine of the viewing angle at which a triangle's texels count fully
MOST_BATCHES = 40  # largest number of batches in an epoch
_TEXTURE_EVERY = 4  # fewest frames whose texture gradients are summed for one step

_PIECE = "descent"
_RATES = {"lights": "light", "log_focals": "focal"}
"""Names of learning rates that differ from the names of their parameters."""
_AT_ONCE = 16
"""Number of frames of a batch whose gradients are in memory together, about 60 MB."""


@dataclass(frozen=True)
class _Place:
    """One timestep of a batch."""

    sequence: int
    row: int


class Descent:
    """A fit in progress: the parameters and the state of their optimisers."""

    def __init__(self, scene: PaperScene, state: PaperState) -> None:
        self.scene, self.state = scene, state
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
        tensors = cache.read(_PIECE)
        if tensors is None:
            return
        unpack_state(self.state, tensors)
        self.done, self.lost = int(tensors["done"]), [(int(s), int(row)) for s, row in tensors["lost"]]
        self._moments = unpack_moments(tensors, "moments/")
        for name, moments in unpack_moments(
            {k: v for k, v in tensors.items() if k.startswith("rows/")}, "rows/"
        ).items():
            sequence, row = (int(part) for part in name.split("/"))
            stepper = self.stepper(sequence, row)
            self._steppers[sequence, row] = replace(
                stepper, whitening=tensors[f"rows/{name}/whitening"], moments=moments
            )

    def offer(self, cache: StageCache) -> None:
        """Offer the present state to the cache, which stores it if it is time."""
        cache.offer(_PIECE, lambda: pack(self.state, self._moments, self._steppers, self.lost, self.done))

    def fit_epoch(self, epoch: int, advance: Advance, cache: StageCache) -> None:
        """Take one step of every frame in random order. Each batch of frames also moves the shared parameters."""
        if self.done >= self.frames * (2 + epoch):
            return
        pairs = [(sequence, row) for sequence, rows in enumerate(self.state.frames) for row in range(len(rows))]
        order = np.random.default_rng((7, epoch)).permutation(len(pairs))
        drawn = [_Place(*pairs[index]) for index in order]
        batches = np.array_split(np.arange(len(drawn)), min(MOST_BATCHES, len(drawn)))
        scale = _GLOBAL_RATE * _EPOCH_DECAY**epoch
        texture_gradient, seen = torch.zeros_like(self.state.texture), 0
        for batch in batches:
            gradients = self._step_frames([drawn[index] for index in batch], scale)
            texture_gradient, seen = texture_gradient + gradients.pop("texture"), seen + len(batch)
            self.step_shared(gradients, scale, 1 / len(batches), len(batch))
            if seen >= _TEXTURE_EVERY:
                roughness = roughness_gradient(self.scene, self.state.texture)
                mean = texture_gradient / seen + roughness / _TEXTURE_EVERY
                self._step("texture", self.state.texture, mean, scale * self.scene.settings.rates.texture)
                texture_gradient, seen = torch.zeros_like(texture_gradient), 0
            advance(len(batch), status=f"epoch {epoch + 1}")
        self.done += self.frames
        self.offer(cache)

    def _step_frames(self, batch: Sequence[_Place], scale: float) -> dict[str, Tensor]:
        """Move each frame's own parameters and return the summed gradients of the shared parameters."""
        weights, total = self.trusted(), {}
        for some in (batch[start : start + _AT_ONCE] for start in range(0, len(batch), _AT_ONCE)):
            for place, gradients in zip(some, map_in_threads(partial(self._gradients, weights), some), strict=True):
                key = (place.sequence, place.row)
                if key not in self._steppers:
                    self._steppers[key] = self.stepper(*key)
                self._steppers[key].step(gradients.pop("row"), scale * self.scene.settings.rates.frame)
                light = torch.zeros_like(self.state.lights)
                light[place.sequence] = gradients.pop("light")
                for name, gradient in (gradients | {"lights": light}).items():
                    total[name] = total[name] + gradient if name in total else gradient
        return total

    def _gradients(self, weights: Float[Tensor, " f"], place: _Place) -> dict[str, Tensor]:
        """Gradients of one timestep's cost by all parameters that it depends on."""
        names = ["row", "identity", "texture", "light"]
        names += ["offsets"] if self.scene.settings.offset_sigma > 0 else []
        names += ["log_focals"] if len(self.state.log_focals) else []
        targets = self.targets(place.sequence, place.row)
        with torch.enable_grad():
            moving, leaves = self.moving(targets[0], names)
            targets = [without_smooth_difference(self.scene, target, moving, weights) for target in targets]
            cost = self.frame_cost(targets, moving, weights, self.state.frames[place.sequence])
            found = torch.autograd.grad(cost, list(leaves.values()), allow_unused=True)
        return {
            name: torch.zeros_like(leaf) if gradient is None else gradient
            for (name, leaf), gradient in zip(leaves.items(), found, strict=True)
        }

    def step_shared(self, gradients: dict[str, Tensor], scale: float, share: float, frames: int) -> None:
        """Move the shared parameters by a batch's summed gradients and its share of the priors' gradients."""
        state, rates = self.state, self.scene.settings.rates
        leaves = {name: getattr(state, name).clone().requires_grad_() for name in gradients}
        with torch.enable_grad():
            expected = torch.autograd.grad(shared_terms(self.scene, replace(state, **leaves)), list(leaves.values()))
        for (name, gradient), beforehand in zip(gradients.items(), expected, strict=True):
            mean = gradient / frames + share * beforehand
            mean = mean * self.scene.offset_share if name == "offsets" else mean
            self._step(name, getattr(state, name), mean, scale * getattr(rates, _RATES.get(name, name)))

    def _step(self, name: str, value: Tensor, gradient: Tensor, rate: float) -> None:
        with torch.no_grad():
            apply_adam(self._moments.setdefault(name, Moments.zeros(value)), value, gradient, rate)

    def frame_cost(
        self,
        targets: Sequence[Target],
        moving: Moving,
        weights: Float[Tensor, " f"],
        around: Float[Tensor, "t p"] | None,
        smoothness: float = 1.0,
    ) -> Float[Tensor, ""]:
        """The cost of a timestep: the mean of its pictures' colours, landmarks, prior, and smoothness.

        Args:
            targets: Pictures of one timestep.
            moving: The parameters.
            weights: Weights of the triangles.
            around: The rows of the sequence, of which those around the timestep count for smoothness. None leaves
                smoothness out. The past alone would continue steady motion against the pictures.
            smoothness: Factor of the cost of smoothness.
        """
        scene, own = self.scene, targets[0]
        vertices, _ = pose_vertices(scene, moving)
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

    def within(self, row: Float[Tensor, "*t p"]) -> Float[Tensor, "*t p"]:
        """The parameters clipped to their bounds."""
        layout = self.scene.layout
        return torch.minimum(torch.maximum(row, layout.lower.to(row)), layout.upper.to(row))

    def stepper(self, sequence: int, row: int, smoothness: float = 1.0) -> RowStepper:
        """A new stepper for a timestep's parameters, whose cost has smoothness by this factor."""
        values = self.state.frames[sequence][row]
        layout = self.scene.layout
        linked = torch.cat([torch.zeros(1), self.scene.sequences[sequence].smoothness.linked, torch.zeros(1)])
        around = linked[row : row + 3] * (smoothness * torch.tensor([1.0, 4.0, 1.0]))
        whitening = self.scene.whitening(sequence, row, values, float(around.sum()))
        return RowStepper(values, whitening, Moments.zeros(values), (layout.lower.float(), layout.upper.float()))

    def targets(self, sequence: int, row: int) -> list[Target]:
        """The pictures of a timestep in all cameras that found a face in it."""
        return [read_target(self.scene, sequence, row, camera) for camera in self.cameras(sequence, row)]

    def cameras(self, sequence: int, row: int) -> list[int]:
        """The cameras that found a face at a timestep."""
        return self.scene.sequences[sequence].seen_by(row)

    def trusted(self) -> Float[Tensor, " f"]:
        """Weight of the texels of each triangle, 0..1, by how frontally the triangle was seen."""
        return self.scene.used * (self.state.visibility / _GOOD_COSINE).clamp_max(1.0)


def pack(
    state: PaperState,
    moments: dict[str, Moments],
    steppers: dict[tuple[int, int], RowStepper],
    lost: list[tuple[int, int]],
    done: int,
) -> dict[str, Tensor]:
    """The complete state of a fit as tensors by name."""
    tensors = state.tensors() | {"done": torch.tensor([done]), "lost": torch.tensor(lost).reshape(-1, 2)}
    every = {f"moments/{name}": own for name, own in moments.items()}
    every |= {f"rows/{sequence}/{row}": own.moments for (sequence, row), own in steppers.items()}
    for name, own in every.items():
        tensors |= {f"{name}/first": own.first, f"{name}/second": own.second, f"{name}/count": own.step.long()}
    return tensors | {f"rows/{sequence}/{row}/whitening": own.whitening for (sequence, row), own in steppers.items()}


def unpack_state(state: PaperState, tensors: dict[str, Tensor]) -> None:
    """Copy the tensors into a state of the same sizes, in place."""
    for name, tensor in state.tensors().items():
        tensor.copy_(tensors[name])


def unpack_moments(tensors: dict[str, Tensor], prefix: str) -> dict[str, Moments]:
    """The moments whose names begin with a prefix, by the rest of their names."""
    names = {name[len(prefix) :].rsplit("/", 1)[0] for name in tensors if name.startswith(prefix)}
    return {
        name: Moments(
            tensors[f"{prefix}{name}/first"], tensors[f"{prefix}{name}/second"],
            tensors[f"{prefix}{name}/count"].to(tensors[f"{prefix}{name}/first"].dtype),
        )
        for name in sorted(names)
    }  # fmt: skip
