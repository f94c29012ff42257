"""Adam for tensors and for single rows of tensors, with a state that can be written to a file."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-12

_SETTLED = 2.0
"""Gradient of a squared cost at one standard deviation; it damps steps with smaller gradients. Plain Adam moves by its
whole rate however small the gradient is, which made each frame tremble about its place."""


@dataclass(eq=False)
class Moments:
    """Running means of gradients and of their squares. Mutable."""

    first: Tensor
    second: Tensor
    count: int = 0

    @staticmethod
    def like(values: Tensor) -> "Moments":
        """Zero moments for values that have not moved yet."""
        return Moments(torch.zeros_like(values), torch.zeros_like(values))

    def step(self, values: Tensor, gradient: Tensor, rate: float, settled: float = _EPSILON) -> None:
        """Move the values in place (Kingma and Ba 2015), by less than `rate` if gradients are not far above `settled`.

        Args:
            values: The values to move.
            gradient: Gradient of the cost by the values.
            rate: Learning rate.
            settled: Gradient at which a step is half of `rate`.
        """
        self.count += 1
        self.first.lerp_(gradient, 1 - _BETA1)
        self.second.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
        root = (self.second / (1 - _BETA2**self.count)).sqrt_().add_(settled)
        moved = self.first / root
        values.sub_(moved.mul_(rate).mul_(1 / (1 - _BETA1**self.count)))


@dataclass(frozen=True, eq=False)
class RowStepper:
    """Moves a timestep's parameters by Adam, in coordinates that landmarks determine equally well."""

    row: Float[Tensor, " p"]
    """The parameters, which are moved in place."""
    whitening: Float[Tensor, "p p"]
    """Transform to parameters from independent coordinates in units of the standard deviations left by landmarks."""
    moments: Moments
    bounds: tuple[Float[Tensor, " p"], Float[Tensor, " p"]]

    @torch.no_grad()
    def step(self, gradient: Float[Tensor, " p"], rate: float) -> None:
        """Take one step of at most about `rate` standard deviations and clip to the bounds."""
        move = torch.zeros_like(self.row)
        self.moments.step(move, gradient @ self.whitening, rate, _SETTLED)
        self.row.add_(self.whitening @ move)
        self.row.copy_(torch.minimum(torch.maximum(self.row, self.bounds[0]), self.bounds[1]))
