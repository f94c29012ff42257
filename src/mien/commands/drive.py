"""`mien drive`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.options import check_driver
from mien.commands.picture import PictureOptions
from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Make an avatar do what someone else does: a video, a sequence, or what a phone or MediaPipe recorded."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder of the avatar."""
    by: Path
    """The driver: a workspace (may be the avatar's own), a video file (tracked first, and kept in the cache), a .csv of
    Live Link Face, or a .json of blend shapes (docs/using.md)."""
    out: Path
    """.mp4, .webm, a folder or NAME_%06d.png; a video or workspace shows the driver on the left."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Which of the avatar's runs (default: the only one)."""
    sequence: str | None = None
    """Which of the driver's sequences (default: the only one)."""
    head_pose: bool = True
    """The head follows the driver's; with --no-head-pose it stays still and only the face moves."""
    alone: bool = False
    """Only the avatar, without the driver's pictures beside it."""
    fps: float | None = None
    """Frames a second that a .csv's timecode counts in (default: the smallest usual rate above its frame numbers)."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def check(self) -> None:
        """Tell what can be told without heavy libraries."""
        open_workspace(self.workspace).pick_run(self.run_name)
        # Of how many frames is not known before the driver is tracked, but a film or a sequence takes any number.
        self.picture.plan(self.out, 2)
        check_driver(self.by, self.sequence, self.fps)

    def run(self) -> None:
        """Track the driver if need be, then pose and render every timestep."""
        from mien.commands.stages.driving import DriveOptions, drive_stage
        from mien.commands.stages.pictures import warn_of_white

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        warn_of_white(self.picture, run_dir)
        options = DriveOptions(self.sequence, self.head_pose, self.alone, self.fps)
        drive_stage(run_dir, self.by, self.out, options, self.picture)
