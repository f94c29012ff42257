"""`mien drive`: an avatar that follows a driver."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.options import check_driver
from mien.commands.picture import PictureOptions
from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Make an avatar follow somebody else: a video, a sequence, or a recording of a phone or of MediaPipe."""

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder of the avatar."""
    by: Path
    """The driver: a workspace (also the avatar's own), a video file (tracked first, and kept in the cache), a .csv of
    Live Link Face, or a .json of blend shapes (docs/using.md)."""
    out: Path
    """Output: an .mp4, a .webm, a folder or NAME_%06d.png. If the driver has pictures, they are on the left."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the avatar's run (default: the only one)."""
    sequence: str | None = None
    """Name of the driver's sequence (default: the only one)."""
    head_pose: bool = True
    """By default, the head follows the driver's head. With --no-head-pose it stays still, and only the face moves."""
    unlimited: bool = False
    """Follow the driver however far. By default, expressions and turns of the head that go beyond what the avatar was
    filmed in are softened, because it has never seen them."""
    alone: bool = False
    """Show only the avatar, without the driver's pictures beside it."""
    fps: float | None = None
    """Frame rate of the timecode in a .csv, in frames per second (default: the smallest usual rate above its frame
    numbers)."""
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = field(default_factory=PictureOptions)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        open_workspace(self.workspace).pick_run(self.run_name)
        # The number of frames is known only after tracking, but a video or numbered pictures take any number.
        self.picture.plan(self.out, 2)
        check_driver(self.by, self.sequence, self.fps)

    def run(self) -> None:
        """Track the driver if necessary, then pose and render every timestep."""
        from mien.commands.stages.driving import DriveOptions, run_driving_stage
        from mien.commands.stages.pictures import warn_of_white

        workspace = open_workspace(self.workspace)
        run_dir = workspace.run_dir(workspace.pick_run(self.run_name))
        warn_of_white(self.picture, run_dir)
        options = DriveOptions(self.sequence, self.head_pose, self.alone, self.fps, self.unlimited)
        run_driving_stage(run_dir, self.by, self.out, options, self.picture)
