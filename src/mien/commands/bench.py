"""`mien bench`."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Render:
    """How fast the native core draws Gaussians on this machine, forward and backward, by size and threads."""

    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print a list of rows for programs."""

    def run(self) -> None:
        """Measure and print."""
        from mien.benchmarking.render import benchmark_suite, format_row

        rows = benchmark_suite()
        if self.as_json:
            print(json.dumps([asdict(row) for row in rows]))
            return
        for row in rows:
            print(format_row(row))


@dataclass(frozen=True)
class Quality:
    """How good the avatars and trackings are: the whole path over reference captures, with figures against the truth.

    Each capture is drawn (once), captured, tracked, trained and evaluated; a stopped command goes on where it was.
    """

    captures: tuple[str, ...] = ()
    """Names of reference captures (default: all; an unknown name lists them)."""
    method: str = "gaussian_avatars"
    """gaussian_avatars, headgas or mono_gaussian_avatar."""
    steps: int = 0
    """Optimiser steps; 0 for each capture's own number."""
    out: Path = Path("out/bench-quality")
    """Folder for the drawn captures, the workspaces and the tables."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print a list of rows for programs."""

    def run(self) -> None:
        """Walk every capture, then print the table."""
        from mien.commands.stages.quality import quality_stage

        quality_stage(self.out, self.captures, self.method, self.steps, as_json=self.as_json)


@dataclass(frozen=True)
class Command:
    """Measure this machine and this version of mien: `mien bench render`, `mien bench quality`."""

    what: Annotated[
        Annotated[Render, tyro.conf.subcommand("render", prefix_name=False)]
        | Annotated[Quality, tyro.conf.subcommand("quality", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> None:
        """Run the chosen benchmark."""
        self.what.run()
