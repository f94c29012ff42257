"""`mien studio`: film, make and take away avatars in a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mien.errors import UserError
from mien.machine.stops import Terminated
from mien.pipeline.names import PORT, check_studio


@dataclass(frozen=True)
class Command:
    """Film yourself in a browser, watch the avatar grow, and take it away (docs/studio.md)."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")] = Path("people")
    """Folder of all people, new or existing. Each is a workspace in it."""
    port: Annotated[int, PORT] = 0
    """Port of the page. 0 means a free one."""
    lan: bool = False
    """Let phones of the local network send films, and reach nothing else: the page shows a QR code for that."""
    browser: bool = True
    """Open the page in the browser of this machine."""

    def check(self) -> None:
        """Check the folder without heavy libraries."""
        from mien.disk.files import check_writable
        from mien.disk.workspace import is_workspace

        check_studio()
        check_writable(self.folder, folder=True)
        if is_workspace(self.folder):
            raise UserError(f"{self.folder}: is the workspace of one person; give the folder that it lies in")

    def run(self) -> None:
        """Serve the page until Ctrl-C. What is made then goes on with the next studio."""
        import webbrowser

        from mien.machine.progress import say
        from mien.studio.server import Serving

        self.folder.mkdir(parents=True, exist_ok=True)
        serving = Serving(self.folder, self.port, self.lan)
        say(f"Open {serving.address} in a browser; Ctrl-C ends the studio")
        try:
            if self.browser:
                webbrowser.open(serving.address)
            serving.wait()
        except KeyboardInterrupt:
            say("The studio is closed; the next one goes on with what was being made")
        except Terminated as stop:
            raise SystemExit(stop.code) from None
        finally:
            serving.stop()
