"""`mien view`: an avatar in a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.errors import UserError
from mien.pipeline.names import PORT, check_avatar, check_driver, check_neutral, check_viewer


@dataclass(frozen=True)
class Command:
    """Show an avatar in a browser: turn it, move its face, play a motion, save pictures and videos (docs/viewer.md)."""

    avatar: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder, or a .mien file."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    play: str | None = None
    """A motion to choose from, beside the workspace's own sequences: anything that `mien drive --by` takes."""
    neutral: str | None = None
    """The face at rest of --play and of the workspace's sequences, as for `mien drive`: first, calm, model, or a video,
    recording, workspace or sequence folder of the driver at rest."""
    port: Annotated[int, PORT] = 0
    """Port of the server. 0 means a free one."""
    follow: bool = False
    """Show the .mien file anew each time it changes."""
    host: str = "127.0.0.1"
    """Address to listen on (default: this machine alone). 0.0.0.0 stands for all addresses of this machine."""
    token: bool = True
    """By default, browsers need the token in the printed address. With --no-token, every user of this machine can use
    the viewer, but not the camera."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        check_avatar(self.avatar, self.run_name)
        if self.follow and not self.avatar.is_file():
            raise UserError(f"--follow: needs a .mien file, and {self.avatar} is a workspace; leave --follow out")
        if self.play is not None:
            check_driver(Path(self.play), None)
        check_neutral(self.neutral)
        check_viewer()

    def run(self) -> None:
        """Load the avatar, and show it until Ctrl-C."""
        from mien.pipeline.view import run_viewing_stage

        run_viewing_stage(
            self.avatar, self.run_name, play=self.play, neutral=self.neutral, host=self.host, port=self.port,
            token=self.token, follow=self.follow,
        )  # fmt: skip
