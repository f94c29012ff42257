"""Progress of a run, and learning rates that depend on it. Needs no torch, because settings hold such rates."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from mien.disk.config import Range


@dataclass(frozen=True)
class Progress:
    """Progress of training: everything that schedules may depend on."""

    step: int
    """Number of steps before this one."""
    steps: int
    """Number of steps of the whole run."""
    epoch: int = 0
    """Number of passes over the training frames that were completed before this step."""
    extent: float = 1.0
    """Extent of the training cameras, in metres (`camera_extent` in `mien.training.footage`). The unit of some rates
    and sizes."""
    frames: int = 1
    """Number of training frames that this step uses. It counts as so many steps."""

    @property
    def fraction(self) -> float:
        """0 at the first step, 1 after the last."""
        return self.step / self.steps

    @property
    def done(self) -> int:
        """Number of steps after this one."""
        return self.step + self.frames

    def reaches(self, every: int) -> bool:
        """Whether a multiple of a number of steps is done after this step, and was not before it."""
        return self.done // every > self.step // every

    def completes(self, steps: Iterable[int]) -> bool:
        """Whether one of these numbers of steps is done after this step, and was not before it."""
        return any(self.step < count <= self.done for count in steps)


def active_degree(degree: int, warmup: float, progress: Progress) -> int:
    """Highest degree of spherical harmonics that is switched on, of `degree`, if all are from the time `warmup` on."""
    return min(degree, int(progress.fraction / max(warmup, 1e-9) * (degree + 1)))


TRAINED = Progress(step=1, steps=1, epoch=1_000_000)
"""Progress after training: every schedule is at its end."""


@dataclass(frozen=True)
class Rate:
    """A learning rate over the run: constant, or log-linear from `start` to `end`."""

    start: Annotated[float, Range(0, 100)]
    """The rate at the first step. With 0, nothing is learned, whatever `end` is."""
    end: Annotated[float | None, Range(1e-12, 100)] = None
    """The rate at the last step. If it is not given, the rate is constant."""

    def at(self, progress: Progress) -> float:
        """The rate at a step."""
        if self.end is None or self.start == 0:
            return self.start
        along = progress.fraction
        return math.exp((1 - along) * math.log(self.start) + along * math.log(self.end))
