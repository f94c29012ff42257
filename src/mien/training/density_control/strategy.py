"""The interface of density control."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor

from mien.avatar.avatar import Posed
from mien.avatar.settings import Progress
from mien.avatar.store import GaussianStore
from mien.gaussians import Rendering

Random = Callable[[], torch.Generator]
"""Creates the generator for a step's random numbers. Few steps need one."""
Redundant = Callable[[], Bool[Tensor, " n"]]
"""Finds the Gaussians that hardly add to any picture. It takes as long as a dozen pictures."""


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
