"""`mien train`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.options import TrainOptions
from mien.errors import UserError
from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Train an avatar on the tracked sequences of a workspace: DIR/runs/NAME. The same command resumes."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder."""
    sequences: tuple[str, ...] = ()
    """Which sequences (default: all)."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the method's)."""
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = field(default_factory=TrainOptions)

    def run(self) -> None:
        """Train to the end."""
        from mien.commands.stages import training_stage

        workspace = open_workspace(self.workspace)
        names = list(self.sequences) or workspace.sequence_names()
        if not names:
            raise UserError(f"{self.workspace}: no sequences to train on; add one with `mien capture` and `mien track`")
        names = [workspace.pick_sequence(name) for name in names]
        run = self.run_name or self.options.method
        training_stage(workspace, names, run, self.options.method_config(), self.options.settings())
