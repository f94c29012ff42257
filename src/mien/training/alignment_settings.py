"""AlignmentSettings: whether and how all frames are aligned again to a quick avatar. Needs no torch."""

from dataclasses import dataclass
from typing import Annotated, Literal

from mien.disk.config import COUNT, POSITIVE, Range, check_ranges
from mien.disk.reading import MAX_SIDE


@dataclass(frozen=True)
class AlignmentSettings:
    """Analysis by synthesis: a quick avatar is trained, and the face parameters of all frames are fitted to it."""

    when: Literal["auto", "always", "never"] = "auto"
    """Whether frames are aligned. Auto: if one camera filmed, the preset is not paper, and the run is not shorter than
    the training of the quick avatar. Several cameras agree on the face already, and the papers train on the tracking
    alone."""
    template_steps: Annotated[int, COUNT] = 3_000
    """Number of training steps of the quick avatar."""
    template_gaussians: Annotated[int, COUNT] = 20_000
    """Largest number of Gaussians of the quick avatar."""
    resolution: Annotated[int, Range(16, MAX_SIDE)] = 256
    """Longer side of the pictures, in pixels, for the quick avatar and for the alignment."""
    iterations: Annotated[int, COUNT] = 8
    """Number of optimiser steps for each frame."""
    rate: Annotated[float, POSITIVE] = 7e-4
    """How far a step turns a head whose gradient has the usual size, in radians. Its position moves by 0.3 of it, in
    metres, joint angles by 3 times and expression coefficients by 10 times as much."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--alignment.{name.replace('_', '-')}")
