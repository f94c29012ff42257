"""Settings of a study's page. Needs no torch."""

from dataclasses import dataclass
from typing import Annotated

from mien.disk.config import Range, check_ranges
from mien.errors import UserError

TILE_UNIT = 16
"""Sides of tiles are multiples of this, the side of H.264's blocks, so that no block holds pixels of two tiles."""


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study's page."""

    clips: Annotated[int, Range(1, 200)] = 10
    """Largest number of clips, spread evenly over the workspaces. The paper showed 10."""
    seconds: Annotated[float, Range(0.1, 60)] = 4.0
    """Longest clip, in seconds. A clip never crosses the end of a held-out part."""
    side: Annotated[int, Range(64, 1024)] = 384
    """Side of each picture in pixels, a multiple of 16. It shows the square around the head."""
    megabytes: Annotated[float, Range(1, 1000)] = 30.0
    """Largest size of the page, in millions of bytes. Videos are compressed until they fit."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of the choice of clips and of the page's opaque names. The same seed, runs and settings give the same
    page."""

    def check(self) -> None:
        """Check that all numbers are in their ranges."""
        check_ranges(self, lambda name: f"--{name}")
        if self.side % TILE_UNIT:
            near = max(64, self.side // TILE_UNIT * TILE_UNIT)
            raise UserError(f"--side {self.side}: give a multiple of {TILE_UNIT}, for example {near}")
