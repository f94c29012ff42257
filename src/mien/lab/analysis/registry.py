"""The analyses, by the name that the command line takes. Needs no torch: a part's function is imported when it runs.

A new analysis is an entry here, and a file named after its method. The file has a function for each part, from a
`mien.lab.analysis.running.Context` to a `Result`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from mien.disk.config import Range, check_ranges
from mien.errors import UserError
from mien.machine.devices import DeviceName


@dataclass(frozen=True)
class AnalysisOptions:
    """The user chooses these options besides the parts."""

    steps: Annotated[int, Range(1, 1_000_000)] = 3_000
    """Number of optimiser steps of each short training."""
    seconds: Annotated[float, Range(0.01, 3600)] = 2.0
    """Seconds to spend on each timed row. A row ends after the first picture that exceeds them."""
    device: DeviceName = "cpu"
    """Device of short trainings and of timed drawing. cuda takes the figures of a GPU."""
    widen: bool = False
    """Widen the ablation of HeadGaS without blending until its PSNR gains less than 0.1 dB."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--{name}")


@dataclass(frozen=True)
class Part:
    """A part of an analysis. Its function has its name, with underscores."""

    name: str
    title: str
    trains: bool = False
    """Whether it trains, for `steps` each time. Such a part runs only if it is asked for."""
    timed: bool = False
    """Whether the result depends on the seconds of a row and on the number of threads."""


@dataclass(frozen=True)
class Analysis:
    """The analysis of a method, and the paper whose figures stand beside the measured ones."""

    method: str
    """Name of the method, as in `mien.avatar.METHODS`, and of the analysis' file."""
    paper: str
    parts: tuple[Part, ...]
    """In the order of the page."""

    @property
    def about_parts(self) -> str:
        """The parts for `mien analyze --help`."""
        return "; ".join(f"{part.name} – {part.title}" for part in self.parts)


_ALL = (
    Analysis(
        "gaussian_avatars",
        "GaussianAvatars (Qian et al., CVPR 2024), supplement",
        (
            Part("growth", "Gaussians and step time over training (Fig. 3)"),
            Part("speed", "Drawing speed and memory (Table 3)", timed=True),
            Part("teeth", "Teeth: the Gaussians on the teeth's triangles (Fig. 1)"),
            Part("teeth-trained", "Teeth: trained with and without the teeth's triangles (Fig. 1)", trains=True),
            Part("scale", "The threshold of the scale loss (section C)", trains=True, timed=True),
        ),
    ),
    Analysis(
        "headgas",
        "HeadGaS (Dhamo et al., ECCV 2024), supplement",
        (
            Part("basis", "What the bases learned: one expression at a time, beside the mesh (Fig. 1)"),
            Part("layers", "Gaussians removed from near to far, also of a mouth that is shut (Fig. 2)"),
            Part("beyond", "Beyond the expressions and the views of training (Fig. 3)"),
            Part("sizes", "Time of a frame against the size of the picture (Fig. 4)", timed=True),
            Part("ablations", "The ablations, trained alike (Table 1)", trains=True, timed=True),
        ),
    ),
    Analysis(
        "mono_gaussian_avatar",
        "MonoGaussianAvatar (Chen et al., SIGGRAPH 2024), supplement",
        (
            Part("times", "Time of training and of a frame (Table 4)", timed=True),
            Part("convergence", "Held-out pictures during a training (Fig. 13)", trains=True),
            Part("resolutions", "Training at 1024x1024 and 512x512 (A.1)", trains=True),
            Part("diversity", "Shorter and less varied clips (Fig. 12, A.4)", trains=True),
        ),
    ),
)
ANALYSES = {one.method.replace("_", "-"): one for one in _ALL}


def chosen_parts(analysis: Analysis, names: Sequence[str], train: bool) -> list[Part]:
    """The parts of those names, in the analysis' order. Without names: all, or without `train` all that need none."""
    known = [part.name for part in analysis.parts]
    for name in names:
        if name not in known:
            raise UserError(f"--parts {name}: no such part; there are: {', '.join(known)}")
    if names:
        return [part for part in analysis.parts if part.name in names or (train and part.trains)]
    return [part for part in analysis.parts if train or not part.trains]
