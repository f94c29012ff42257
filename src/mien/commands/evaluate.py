"""`mien evaluate`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Score a run on its held-out frames: DIR/runs/NAME/metrics.json and report.html, beside two baselines."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which run (default: the only one)."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print metrics.json on standard output."""

    def run(self) -> None:
        """Evaluate, then print."""
        from mien.commands.stages import evaluation_stage

        workspace = open_workspace(self.workspace)
        metrics = evaluation_stage(workspace, workspace.pick_run(self.run_name))
        if self.as_json:
            print(json.dumps(metrics, indent=1))
