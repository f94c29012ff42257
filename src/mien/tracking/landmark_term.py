"""The landmark cost: robust distances between detected and projected landmarks, with priors on the parameters."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.tracking.landmark_model import LandmarkModel, Linearization
from mien.tracking.solver import NormalEquations, SharedEquations, joined

_CHUNK = 48
"""Timesteps linearised at once: bounds the memory to about 100 MB."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What does not change over the sequence."""

    identity: Float[Tensor, " i"]
    bias: Float[Tensor, "l 3"]
    """How far each landmark lies from where the model has it, at rest, in the head frame, metres: the detector means
    other points than the embedding, and no identity basis spans every face."""
    camera: Camera


@dataclass(frozen=True, eq=False)
class LandmarkTerm:
    """Costs of b frames: sum_l w_l rho(|r_l|^2 / sigma^2), plus the layout's prior.

    rho(s) = c^2 s / (c^2 + s) (Geman and McClure): an outlier's pull fades.
    """

    model: LandmarkModel
    detected: Float[Tensor, "b l 2"]
    """Pixels."""
    weights: Float[Tensor, " l"]
    """They sum to the number of independent points that all landmarks are worth."""
    sigma: float
    """Expected distance, pixels."""
    outlier: float
    """c: beyond this many sigmas a landmark hardly counts."""

    def at(self, frames: Int[Tensor, " k"]) -> "LandmarkTerm":
        """The same term over some of the frames."""
        return replace(self, detected=self.detected[frames])

    def _robust(self, residual: Float[Tensor, "b l 2"]) -> tuple[Float[Tensor, " b"], Float[Tensor, "b l"]]:
        squared = (residual**2).sum(-1) / self.sigma**2
        least = self.outlier**2
        cost = (self.weights * least * squared / (least + squared)).sum(-1)
        return cost, self.weights * (least / (least + squared)) ** 2 / self.sigma**2

    def _prior(self, state: Float[Tensor, "b p"]) -> tuple[Float[Tensor, " b"], Float[Tensor, "b p"]]:
        pull = state @ self.model.layout.precision
        return (state * pull).sum(-1), pull

    def cost(self, state: Float[Tensor, "b p"], subject: Subject) -> Float[Tensor, " b"]:
        """Of each frame."""
        projected = self.model.project(state, subject.identity, subject.bias, subject.camera)
        return self._robust(projected - self.detected)[0] + self._prior(state)[0]

    def residuals(self, state: Float[Tensor, "b p"], subject: Subject) -> Float[Tensor, "b l"]:
        """Distances of detected from projected landmarks, pixels."""
        projected = self.model.project(state, subject.identity, subject.bias, subject.camera)
        return (projected - self.detected).norm(dim=-1)

    def linearizations(
        self, state: Float[Tensor, "b p"], subject: Subject, with_identity: bool = False
    ) -> "Iterator[WeightedLinearization]":
        """Linearisations of all frames, a bounded number at a time."""
        for start in range(0, len(state), _CHUNK):
            part = slice(start, start + _CHUNK)
            at = self.model.linearize(state[part], subject.identity, subject.bias, subject.camera, with_identity)
            residual = at.pixels - self.detected[part]
            cost, weights = self._robust(residual)
            prior_cost, pull = self._prior(state[part])
            yield WeightedLinearization(at, residual, weights, cost + prior_cost, pull)

    def equations(self, state: Float[Tensor, "b p"], subject: Subject) -> NormalEquations:
        """Of each frame on its own, the shared parameters fixed."""
        precision = self.model.layout.precision
        return joined([part.frame_equations(precision) for part in self.linearizations(state, subject)])


@dataclass(frozen=True, eq=False)
class WeightedLinearization:
    """A linearisation with its residuals and their current robust weights."""

    at: Linearization
    residual: Float[Tensor, "b l 2"]
    weights: Float[Tensor, "b l"]
    cost: Float[Tensor, " b"]
    prior_pull: Float[Tensor, "b p"]
    """Half the prior's gradient."""

    def _weighted(self, derivative: Float[Tensor, "b l 2 s"]) -> Float[Tensor, "b n s"]:
        return (derivative * self.weights.sqrt()[:, :, None, None]).flatten(1, 2)

    def frame_equations(self, precision: Float[Tensor, "p p"]) -> NormalEquations:
        """Half gradient and half Hessian by the frames' own parameters."""
        jacobian = self._weighted(self.at.by_frame)
        gradient = jacobian.mT @ self._weighted(self.residual[..., None])
        return NormalEquations(self.cost, gradient[..., 0] + self.prior_pull, jacobian.mT @ jacobian + precision)

    def shared_equations(self) -> SharedEquations:
        """Blocks of the shared parameters: identity, then the logarithm of the focal length."""
        assert self.at.by_identity is not None
        shared = self._weighted(torch.cat([self.at.by_identity, self.at.by_log_focal[..., None]], dim=-1))
        own = self._weighted(self.at.by_frame)
        gradient = shared.mT @ self._weighted(self.residual[..., None])
        return SharedEquations(own.mT @ shared, (shared.mT @ shared).sum(0), gradient[..., 0].sum(0))

    def bias_equations(self) -> tuple[Float[Tensor, "l 3 3"], Float[Tensor, "l 3"]]:
        """Half Hessian and half gradient of every landmark's bias."""
        weighted = self.at.by_bias * self.weights[:, :, None, None]
        hessian = torch.einsum("blxc,blxd->lcd", weighted, self.at.by_bias)
        return hessian, torch.einsum("blxc,blx->lc", weighted, self.residual)
