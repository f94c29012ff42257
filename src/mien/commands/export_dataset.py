"""`mien export-dataset`: captures in the layouts of other laboratories, and the videos that a benchmark scores."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mien.commands.export import any_of
from mien.datasets.layouts.layout import LAYOUTS, MatteKind, check_new_folder, find_layout
from mien.disk.files import check_writable
from mien.disk.workspace import open_workspace
from mien.errors import UserError

SUBMISSION = "nersemble-benchmark"
"""Name for `--format` of the benchmark's submission folder."""


def _about_format() -> str:
    return (
        f"Name of the layout: {any_of(each.name for each in LAYOUTS)} (docs/datasets.md). Or {SUBMISSION}: a folder of "
        f"videos that the benchmark of that name scores; `mien export-dataset --format {SUBMISSION} --help` shows its "
        "options."
    )


@dataclass(frozen=True)
class Command:
    """Write a tracked capture in the layout of another laboratory, for programs that train elsewhere.

    With --format nersemble-benchmark, write the videos that the NeRSemble benchmark asks for.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    out: Path
    """The folder to write, which has to be new."""
    format: Annotated[str, _about_format]
    sequence: str | None = None
    """The sequence that is written (default: the only one)."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Hold out what this run holds out."""
    split: Literal["blocks", "tail", "none", "dataset"] | None = None
    """Without --run, the split, as for `mien train` (default: that of the dataset that it was imported from, or
    blocks)."""
    mattes: MatteKind = "head"
    """Mattes of the head above the cut at the neck, which mien trains on and scores, or of the whole person."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if find_layout(self.format) is None:
            names = any_of([*(each.name for each in LAYOUTS), SUBMISSION])
            raise UserError(f"--format {self.format}: there is no such layout; choose {names}")
        if self.run_name is not None and self.split is not None:
            raise UserError(f"--split {self.split}: --run {self.run_name} has a split of its own; give only one")
        workspace = open_workspace(self.workspace)
        if self.run_name is not None:
            workspace.pick_run(self.run_name)
        name = workspace.pick_sequence(self.sequence)
        if name not in workspace.tracked_names():
            raise UserError(
                f"{self.workspace}: the sequence {name} is not tracked, and a capture is written with its tracking; "
                f"run {shlex.join(['mien', 'track', str(self.workspace)])}"
            )
        check_new_folder(self.out)

    def run(self) -> None:
        """Write the capture."""
        from mien.pipeline.export_dataset import export_capture, settings_of

        workspace, layout = open_workspace(self.workspace), find_layout(self.format)
        assert layout is not None
        sequence = workspace.pick_sequence(self.sequence)
        settings = settings_of(workspace, sequence, self.run_name, self.split)
        export_capture(workspace, sequence, layout, self.out, settings, self.mattes)


@dataclass(frozen=True)
class Submission:
    """Render a run for the NeRSemble benchmark: the videos that it asks for of one person."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    benchmark: Path
    """The person's folder of the benchmark, whose name is a number."""
    out: Path
    """The submission folder, which takes the people one after the other."""
    format: Literal["nersemble-benchmark"]
    """The benchmark that scores the videos."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if not (self.benchmark / "calibration" / "camera_params.json").is_file():
            raise UserError(
                f"--benchmark {self.benchmark}: has no calibration/camera_params.json; give the folder of a person of "
                "the benchmark"
            )
        name = self.benchmark.resolve().name
        if not (name.isascii() and name.isdigit() and len(name) <= 3):
            raise UserError(
                f"--benchmark {self.benchmark}: its name is not the number of a person, such as 393; give the folder "
                "under that name"
            )
        open_workspace(self.workspace).pick_run(self.run_name)
        check_writable(self.out, folder=True)
        if (self.out / name.zfill(3)).exists():
            raise UserError(f"{self.out / name.zfill(3)}: is there already; delete it, or give another --out")

    def run(self) -> None:
        """Draw the videos."""
        from mien.pipeline.export_dataset import export_submission

        workspace = open_workspace(self.workspace)
        export_submission(workspace, workspace.pick_run(self.run_name), self.benchmark, self.out)


def task_of(arguments: Sequence[str]) -> type:
    """The command with the options that its --format has."""
    scored = bool({SUBMISSION, f"--format={SUBMISSION}"} & {*arguments})
    kind, other = (Submission, Command) if scored else (Command, Submission)
    lacking = {f"--{each.name}" for each in fields(other)} - {f"--{each.name}" for each in fields(kind)}
    for option in sorted(lacking & {each.partition("=")[0] for each in arguments}):
        owners = any_of(each.name for each in LAYOUTS) if scored else SUBMISSION
        raise UserError(f"{option} is an option of --format {owners}; leave it out")
    return kind
