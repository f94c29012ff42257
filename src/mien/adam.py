"""Adam's state for one tensor, which training and the paper's tracking share. Each has its own update."""

from dataclasses import dataclass
from threading import local
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999
"""Decay of both running means per update (Kingma and Ba 2015)."""
EPSILON = 1e-15
"""Number added to the root of the second moment, as in 3D Gaussian Splatting, unless a group of parameters says
otherwise. Kingma and Ba propose 1e-8, which networks are mostly trained with."""


@dataclass(eq=False)
class Moments:
    """Adam's state for one tensor. Mutable."""

    PER_ROW: ClassVar = ("first", "second")
    """Fields with the first axis of the tensor."""

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


@dataclass(eq=False)
class FactoredMoments:
    """The optimiser's state for a tensor [n, k, f] with a `FactoredGradient`. Mutable.

    There is no running mean of the gradient, and one second moment for all k. A row of the tensor without a gradient
    keeps its state, so each row has its own bias correction.
    """

    PER_ROW: ClassVar = ("second", "weights")
    """Fields with the first axis of the tensor."""

    second: Float[Tensor, "n f"]
    """Running mean of the squared gradient, which is itself a mean over the axis of k."""
    weights: Float[Tensor, " n"]
    """Running mean of 1, which `second` is divided by: 1 - BETA2 to the number of updates of the row."""

    @staticmethod
    def zeros(like: Float[Tensor, "n k f"]) -> "FactoredMoments":
        """The state before the first update of a tensor."""
        return FactoredMoments(torch.zeros_like(like[:, 0]), like.new_zeros(len(like)))


class FactoredTerm(NamedTuple):
    """An outer product: adds rows[n, f] columns[k], or with `places` each row's own columns out of a table [g, k]."""

    rows: Float[Tensor, "n f"]
    columns: Float[Tensor, "*g k"]
    places: Int[Tensor, " n"] | None = None


class FactoredGradient:
    """The gradient of a tensor [n, k, f] as a sum of outer products, so that it is never made. Mutable.

    A backward pass adds to it and the optimiser clears it, like `Tensor.grad`. Each thread has its own terms, so that
    their order does not depend on which backward pass is the faster one.
    """

    def __init__(self) -> None:
        self._of_thread = local()

    @property
    def terms(self) -> list[FactoredTerm]:
        """The terms that backward passes of this thread added."""
        if not hasattr(self._of_thread, "terms"):
            self._of_thread.terms = []
        return self._of_thread.terms

    def __reduce__(self) -> tuple[type["FactoredGradient"], tuple[()]]:
        """A copy has no terms: those belong to a thread and a step."""
        return FactoredGradient, ()

    def take(self) -> list[FactoredTerm]:
        """Return the terms, and clear them."""
        terms, self._of_thread.terms = self.terms, []
        return terms
