"""`mien train`: from trackings to an avatar."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.train_options import TrainOptions
from mien.disk.workspace import open_workspace
from mien.pipeline.names import check_viewer
from mien.training.settings import check_held_out
from mien.training.splits.benchmark import BENCHMARK_SPLIT
from mien.training.splits.named import NAMED_SPLIT, NamedSplit, split_by_name, with_named_split
from mien.training.splits.own import OWN_SPLIT


@dataclass(frozen=True)
class Command:
    """Train an avatar on the tracked sequences of a workspace, in DIR/runs/NAME. The same command resumes the run."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    sequences: tuple[str, ...] = ()
    """Names of the sequences (default: all tracked ones). Those of --hold-out belong to the run as well."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the method's name)."""
    view: bool = False
    """Show the avatar in a browser while it trains."""
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = field(default_factory=TrainOptions.of)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.pipeline.names import run_name

        self.options.check()
        if self.view:
            check_viewer()
        workspace, settings = open_workspace(self.workspace), self.options.settings()
        run_name(self.run_name or self.options.method)
        names = workspace.pick_tracked(self.sequences, self.options.hold_out)
        if settings.split == NAMED_SPLIT:
            split = self._named_split(names)
            names, settings = list(split.sequences), with_named_split(settings, split)
        check_held_out(names, settings)

    def run(self) -> None:
        """Train the run to its end."""
        from mien.pipeline.names import run_name
        from mien.pipeline.train import (
            fill_in_benchmark_split,
            fill_in_named_split,
            fill_in_own_split,
            run_training_stage,
        )
        from mien.training.run import check_run

        workspace = open_workspace(self.workspace)
        method, settings = self.options.method_config(), self.options.settings()
        run = run_name(self.run_name or self.options.method)
        names = workspace.pick_tracked(self.sequences, self.options.hold_out)
        if settings.split == NAMED_SPLIT:
            split = self._named_split(names)
            names, settings = list(split.sequences), fill_in_named_split(workspace, settings, split)
        if settings.split == BENCHMARK_SPLIT:
            settings = fill_in_benchmark_split(workspace, settings, names)
        if settings.split == OWN_SPLIT:
            settings = fill_in_own_split(workspace, settings, names)
        check_run(workspace.run_dir(run), method, settings, names)
        self.options.say_what_is_ignored()
        run_training_stage(workspace, names, run, method, settings, self.view)

    def _named_split(self, names: list[str]) -> NamedSplit:
        return split_by_name(names, self.workspace.resolve().name, self.options.subject)
