"""Adam's state for one tensor, which training and the paper's tracking share. Each has its own update."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999
"""Decay of both running means per update (Kingma and Ba 2015)."""


@dataclass(eq=False)
class Moments:
    """Adam's state for one tensor. Mutable."""

    first: Tensor
    """Running mean of the gradient."""
    second: Tensor
    """Running mean of the squared gradient."""
    step: Float[Tensor, ""]
    """Number of updates so far."""

    @staticmethod
    def zeros(like: Tensor) -> "Moments":
        """The state before the first update of a tensor."""
        # The step count stays on the CPU: numbers computed from it are needed there and must not wait for a GPU.
        return Moments(torch.zeros_like(like), torch.zeros_like(like), torch.zeros((), dtype=like.dtype))
