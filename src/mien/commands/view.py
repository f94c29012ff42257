"""`mien view`: an avatar in a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.commands.options import check_driver, check_viewer
from mien.errors import UserError
from mien.workspace import open_workspace

_MAX_PORT = 65535
_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Command:
    """Show an avatar in a browser: turn it, move its face, play a motion, save pictures and videos (docs/viewer.md)."""

    avatar: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder, or a .mien file."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the only one)."""
    play: str | None = None
    """A motion to choose from, beside the workspace's own sequences: anything that `mien drive --by` takes."""
    port: int = 0
    """Port of the server, from 1 to 65535. 0 means a free one."""
    follow: bool = False
    """Show the .mien file anew each time it changes."""
    host: str = _LOOPBACK
    """Address to listen on. Beyond loopback, for example 0.0.0.0, browsers need the token in the printed address."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        if self.avatar.is_file():
            if self.run_name is not None:
                raise UserError(f"--run {self.run_name}: a file holds one avatar; leave --run out")
            if self.avatar.suffix.lower() != ".mien":
                raise UserError(f"{self.avatar}: is no .mien file; give one, or a workspace's folder")
        elif self.avatar.suffix.lower() == ".mien" and not self.avatar.exists():
            raise UserError(f"{self.avatar}: no such file; write one with `mien export DIR --out me.mien`")
        else:
            open_workspace(self.avatar).pick_run(self.run_name)
        if self.follow and not self.avatar.is_file():
            raise UserError(f"--follow: needs a .mien file, and {self.avatar} is a workspace; leave --follow out")
        if not 0 <= self.port <= _MAX_PORT:
            raise UserError(f"--port {self.port}: give a number from 1 to {_MAX_PORT}, or 0 for a free one")
        if self.play is not None:
            check_driver(Path(self.play), None)
        check_viewer()

    def run(self) -> None:
        """Load the avatar, and show it until Ctrl-C."""
        from mien.commands.stages.viewing import Place, run_viewing_stage

        run_viewing_stage(self.avatar, self.run_name, self.play, Place(self.host, self.port), self.follow)
