"""`mien drive`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Play an avatar with another sequence's tracking into an mp4: driver on the left, avatar on the right."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder of the avatar."""
    by: Path
    """Workspace folder of the driver (may be the avatar's own)."""
    out: Path
    """The .mp4 to write."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which of the avatar's runs (default: the only one)."""
    sequence: str | None = None
    """Which of the driver's sequences (default: the only one)."""
    head_pose: bool = True
    """Whether the head follows the driver's; else only the expression does."""
    alone: bool = False
    """Only the avatar, without the driver's pictures beside it."""

    def run(self) -> None:
        """Pose and render every timestep of the driver."""
        from mien.commands.stages import drive_stage

        workspace, driver = open_workspace(self.workspace), open_workspace(self.by)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        sequence_dir = driver.sequence_dir(driver.pick_sequence(self.sequence))
        drive_stage(run_dir, sequence_dir, self.out, head_pose=self.head_pose, alone=self.alone)
