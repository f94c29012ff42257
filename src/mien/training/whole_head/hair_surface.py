"""The surface of hair, which rises and sinks as a whole during training.

How high hair stands is measured only where it was on an outline. Elsewhere its height is a guess, although a head that
turns shows it: at a wrong height, hair slides over the scalp. One Gaussian alone cannot follow, because its neighbours
hide what it would gain. So the gradients of all Gaussians on a patch of scalp are added up, and the patch moves along
its normals together with the limits of the surface. What no picture shows moves with what is beside it. Nicolet et al.
2021 (Large steps in inverse rendering of geometry) show that smoothed gradients make large and smooth steps.

The gradient is that of all losses. The position penalty of a method is among them and pulls towards the scalp.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import BoundSurface, SurfacePrior
from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry

_HAIR_BEGIN = 0.03  # time of the first correction, as a fraction of the run
_HAIR_END = 0.6  # time of the last correction, as a fraction of the run. Their size falls to 0 until then
_HAIR_REACH = 0.012
"""Distance in metres over which gradients are smoothed (standard deviation of a Gaussian). Measured: 0.1 dB more at 30
to 60 degrees than 20 mm with smaller corrections, which does not decide anything (log, 11-24)."""
_HAIR_SAME_SIDE = 0.3  # cosine between two normals from which triangles belong to the same side of a fold
_HAIR_FIRST_DECAY = 0.9  # decay of the running mean of the gradient. Of the paper (Adam, Kingma and Ba 2015)
_HAIR_SECOND_DECAY = 0.98  # decay of the running mean of its square
_HAIR_LOWEST_SHIFT = -0.004  # how far hair may sink below the scalp, in metres
_HAIR_FURTHEST_SHIFT = 0.03  # how far it may move at all, in metres

_EPSILON = 1e-12


@dataclass(eq=False)
class HairSurface:
    """How far the surface of hair has moved since the start, and the state of its optimiser."""

    scalp: Int[Tensor, " k"]
    """Triangles that move."""
    kernel: Float[Tensor, "k k"]
    """Weights of the scalp's triangles for each other, which add up gradients."""
    mean: Float[Tensor, "k k"]
    """The same, scaled to means over the area."""
    shown: Bool[Tensor, " k"]
    """Triangles with Gaussians that pictures train. Gradients of others do not count."""
    start: SurfacePrior
    """The surface as it was known before training."""
    state: dict[str, Tensor]
    """Tensors that training changes, by name: `shift` in metres along the normals, its moments, and the gradient since
    the last correction, [k] each; `count`, the number of corrections."""

    def collect(self, surface: BoundSurface, fraction: float) -> None:
        """Add the gradients of a step, after its backward pass, unless no correction follows the time `fraction`."""
        gradient = surface.height_gradient() if fraction < _HAIR_END else None
        if gradient is not None:
            self.state["gradient"] += gradient[self.scalp].to(self.kernel) * self.shown

    def correct(self, surface: BoundSurface, fraction: float, rate: float) -> bool:
        """Move the avatar's Gaussians along the normals if it is time for that. Return whether they moved.

        `rate` is the size of a first correction in metres, where all gradients agree.
        """
        begin, end, furthest = _HAIR_BEGIN, _HAIR_END, _HAIR_FURTHEST_SHIFT
        moves = rate > 0 and begin <= fraction < end
        if moves:
            step = self._step() * rate * (end - fraction) / (end - begin)
            before = self.state["shift"].clone()
            lowest = _HAIR_LOWEST_SHIFT - self.start.hair[self.scalp]
            self.state["shift"] = (before - step).clamp(-furthest, furthest).maximum(lowest)
            surface.raise_by(self._on_all(self.state["shift"] - before))
        self.state["gradient"] = torch.zeros_like(self.state["gradient"])
        return moves

    def prior(self) -> SurfacePrior:
        """Return the surface as it is known now: the hair moved, the rest as at the start."""
        return replace(self.start, hair=(self.start.hair + self.shift).clamp_min(0))

    @property
    def shift(self) -> Float[Tensor, " f"]:
        """The shift of all triangles along their normals, in metres; 0 outside of the scalp."""
        return self._on_all(self.state["shift"])

    def to(self, like: Tensor) -> "HairSurface":
        """The same on the device of `like`, with its dtype."""
        state = {name: own.to(like) for name, own in self.state.items()}
        places = self.scalp.to(like.device), self.kernel.to(like), self.mean.to(like), self.shown.to(like.device)
        return HairSurface(*places, self.start.to(like), state)

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors of `state`."""
        self.state = {name: state[name].to(own) for name, own in self.state.items()}

    def _step(self) -> Float[Tensor, " k"]:
        """Adam's step for the smoothed gradient, at most about 1. Neighbours share the second moment."""
        gradient, state = self.kernel @ self.state["gradient"], self.state
        state["count"] = state["count"] + 1
        state["first"] = torch.lerp(gradient, state["first"], _HAIR_FIRST_DECAY)
        state["second"] = torch.lerp(gradient.square(), state["second"], _HAIR_SECOND_DECAY)
        first = state["first"] / (1 - _HAIR_FIRST_DECAY ** state["count"])
        second = self.mean @ state["second"] / (1 - _HAIR_SECOND_DECAY ** state["count"])
        return first / (second.sqrt() + _EPSILON)

    def _on_all(self, values: Float[Tensor, " k"]) -> Float[Tensor, " f"]:
        return torch.zeros_like(self.start.hair).index_copy(0, self.scalp, values)


@torch.no_grad()
def hair_surface(avatar: Avatar, prior: SurfacePrior) -> HairSurface | None:
    """The surface of the hair at the start of a run. None if the face model has no scalp. All is on the CPU."""
    vertices = avatar.face_model.head_vertices(avatar.subject)[0].detach()
    scalp = head_parts(avatar.face_model).scalp.nonzero()[:, 0]
    if not len(scalp):
        return None
    geometry = triangle_geometry(vertices.float(), avatar.face_model.faces)
    middles, areas, normals = (values[scalp] for values in geometry)
    apart = torch.cdist(middles, middles, compute_mode="donot_use_mm_for_euclid_dist") / _HAIR_REACH
    kernel = torch.exp(-0.5 * apart.square()) * (apart < 3) * (normals @ normals.T > _HAIR_SAME_SIDE)
    mean = kernel * areas
    mean = mean / mean.sum(1, keepdim=True)
    shown = torch.ones_like(scalp, dtype=torch.bool) if prior.filled_in is None else ~prior.filled_in[scalp]
    state = {name: prior.hair.new_zeros(len(scalp)) for name in ("shift", "first", "second", "gradient")}
    state["count"] = prior.hair.new_zeros(())
    return HairSurface(scalp, kernel.to(prior.hair), mean.to(prior.hair), shown, prior, state)
