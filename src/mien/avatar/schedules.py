"""How far a run is, and learning rates that depend on it; without torch, because settings hold such rates."""

import math
from dataclasses import dataclass
from typing import Annotated

from mien.ranges import FRACTION, Range


@dataclass(frozen=True)
class Progress:
    """How far training is: all that schedules may depend on."""

    step: int
    """Steps done before this one."""
    steps: int
    """Steps of the whole run."""
    epoch: int = 0
    """Passes over the training frames done before this one."""

    @property
    def fraction(self) -> float:
        """0 at the first step, 1 after the last."""
        return self.step / self.steps


TRAINED = Progress(step=1, steps=1, epoch=1_000_000)
"""The state after training: every schedule at its end."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run: constant, or log-linear from `start` to `end`."""

    start: Annotated[float, Range(0, 100)]
    """The rate at the first step, or at `begin`. With 0, nothing is learned, whatever the end is."""
    end: Annotated[float | None, Range(1e-12, 100)] = None
    """The rate at the last step. Without it, the rate stays as it starts."""
    begin: Annotated[float, FRACTION] = 0.0
    """The fraction of the run before which the rate is 0."""

    def at(self, progress: Progress) -> float:
        """The rate of one step."""
        if progress.fraction < self.begin:
            return 0.0
        if self.end is None or self.start == 0:
            return self.start
        along = (progress.fraction - self.begin) / max(1 - self.begin, 1e-9)
        return math.exp((1 - along) * math.log(self.start) + along * math.log(self.end))
