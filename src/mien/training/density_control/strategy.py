"""The interface of density control."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.avatar import Posed
from mien.avatar.settings import Progress
from mien.avatar.store import GaussianStore
from mien.gaussians import Rendering

Random = Callable[[], torch.Generator]
"""Creates the generator for a step's random numbers. Few steps need one."""
Redundant = Callable[[], Bool[Tensor, " n"]]
"""Finds the Gaussians that hardly add to any picture. It takes as long as a dozen pictures."""


def count_each(*masks: Bool[Tensor, " n"]) -> list[int]:
    """How many entries of each mask are set. It is the one wait for a GPU in a round."""
    return torch.stack([mask.sum() for mask in masks]).tolist()


def places_in(mask: Bool[Tensor, " n"], count: int) -> Int[Tensor, " p"]:
    """The indices that a mask selects, whose number is known."""
    return torch.nonzero_static(mask, size=count)[:, 0]


def with_most_visible(kept: Bool[Tensor, " n"], opacities: Float[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """What is kept; if that is nothing, the Gaussian that was most visible."""
    best = torch.zeros_like(kept).index_fill_(0, opacities.argmax(0, keepdim=True), 1)
    return torch.where(kept.any(), kept, best)


class DensityStrategy(ABC):
    """Observes every step, and changes the store in some of them."""

    @abstractmethod
    def observe(self, posed: Posed, rendering: Rendering) -> None:
        """Update the statistics after a step's backward pass, once for each frame. `posed` holds one timestep."""

    @abstractmethod
    def adapt(self, store: GaussianStore, posed: Posed, progress: Progress, random: Random) -> bool:
        """Add and remove Gaussians if it is time for that. Called after the optimiser's step.

        Returns whether the number or the order of the Gaussians may have changed.
        """

    @abstractmethod
    def thin(self, store: GaussianStore, redundant: Redundant) -> None:
        """Remove redundant Gaussians between two rounds, if the strategy removes any."""

    @abstractmethod
    def state(self) -> dict[str, Tensor]:
        """Tensors that a checkpoint has to save."""

    @abstractmethod
    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
