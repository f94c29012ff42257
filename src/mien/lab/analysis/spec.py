"""An analysis has a method, and parts that can be chosen. No torch is needed, because the command line checks it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from mien.disk.config import Range, check_ranges
from mien.errors import UserError
from mien.plugins import named

if TYPE_CHECKING:
    from mien.lab.analysis.context import Context
    from mien.lab.analysis.result import PartResult


@dataclass(frozen=True)
class AnalysisOptions:
    """The user chooses these options besides the parts."""

    steps: Annotated[int, Range(1, 1_000_000)] = 3_000
    """Number of optimiser steps of each short training."""
    seconds: Annotated[float, Range(0.01, 3600)] = 2.0
    """Seconds to spend on each timed row. A row ends after the first picture that exceeds them."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--{name}")


@dataclass(frozen=True)
class Part:
    """A part of an analysis."""

    name: str
    summary: str
    """Title of the part's section on the page."""
    function: str
    """"MODULE:FUNCTION": a function from a `Context` to a `PartResult`. It is imported when the part runs."""
    options: tuple[str, ...] = ()
    """Names of the options that change the result. The part is computed again if one of them changes."""
    timed: bool = False
    """Whether the result depends on the number of threads."""
    trainings: int = 0
    """Number of short trainings. Parts with trainings run only if they are asked for."""

    def run(self, context: "Context") -> "PartResult":
        """Compute the part."""
        return named(self.function)(context)


@dataclass(frozen=True)
class Analysis:
    """The analysis of a method."""

    method: str
    """Name of the method, as in `mien.avatar.METHODS`."""
    paper: str
    """The paper whose figures stand beside the measured ones."""
    parts: tuple[Part, ...]
    about_parts: str = ""
    """The parts, for `mien analyze --help`: each name, and in brackets what it measures."""


def chosen_parts(analysis: Analysis, names: Sequence[str], train: bool) -> list[Part]:
    """The parts of those names, in the analysis' order. Without names: all, or without `train` all that need none."""
    known = [part.name for part in analysis.parts]
    for name in names:
        if name not in known:
            raise UserError(f"--parts {name}: no such part; there are: {', '.join(known)}")
    if names:
        return [part for part in analysis.parts if part.name in names or (train and part.trainings)]
    return [part for part in analysis.parts if train or not part.trainings]
