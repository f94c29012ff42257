"""`mien train`: from trackings to an avatar."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.train_options import TrainOptions
from mien.disk.workspace import open_workspace
from mien.pipeline.names import check_viewer, run_name
from mien.training.settings import PRESETS, check_held_out
from mien.training.settings.splits import SPLITS, Recordings, fill_in


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
        self.options.check()
        if self.view:
            check_viewer()
        settings = self.options.settings()
        run_name(self.run_name or self.options.method)
        given = self._given()
        check_held_out(SPLITS[settings.split].used(given), fill_in(settings, given))

    def run(self) -> None:
        """Train the run to its end."""
        from mien.pipeline.train import fill_in_split, run_training_stage
        from mien.training.run import check_run

        workspace = open_workspace(self.workspace)
        method, settings = self.options.method_config(), self.options.settings()
        run = run_name(self.run_name or self.options.method)
        names, settings = fill_in_split(workspace, settings, self._given())
        check_run(workspace.run_dir(run), method, settings, names)
        self.options.say_what_is_ignored()
        run_training_stage(workspace, names, run, method, settings, self.view, PRESETS[self.options.preset].published)

    def _given(self) -> Recordings:
        names = open_workspace(self.workspace).pick_tracked(self.sequences, self.options.hold_out)
        return Recordings(dict.fromkeys(names), self.workspace.resolve().name, self.options.subject)
