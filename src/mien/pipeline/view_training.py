"""A viewer that shows an avatar while it trains: another process reads what training writes from time to time."""

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mien.avatar.avatar import Avatar
from mien.avatar.baking import make_portable
from mien.camera import Camera
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.system import PARENT_VARIABLE, lower_priority
from mien.runtime.file import write_portable

LEAST_SECONDS = 2.0
"""Least time between two pictures of the state."""
_SHARE = 1 / 40
"""Largest share of the time that training spends on showing itself. The viewer takes another one, at lower priority."""


class TrainingView:
    """Shows the avatar of a run in browsers, from its first steps to its end. Call it after each step."""

    def __init__(self, name: str, camera: Camera, growing: Path | None = None, viewer: bool = True) -> None:
        """Prepare the viewer, which starts at the first call. The page has that name and that first view.

        `growing` is the file that the avatar is written to, and that stays. Without it, the file is a temporary one.
        Without `viewer`, the avatar is only written.
        """
        self._name, self._camera, self._has_viewer = name, camera, viewer
        self._folder = Path(tempfile.mkdtemp(prefix="mien-view-"))
        self._file = growing or self._folder / "training.mien"
        self._due = 0.0
        self._viewer: subprocess.Popen[bytes] | None = None

    def __call__(self, avatar: Avatar) -> None:
        """Write the avatar for the viewer, if it is time. If it cannot be shown, say so once and go on."""
        began = time.monotonic()
        if began < self._due:
            return
        try:
            write_portable(self._file, make_portable(avatar, self._camera, self._name, to_share=False))
        except (UserError, OSError) as error:
            say(f"the growing avatar cannot be shown ({error}); training goes on without that")
            self._due = math.inf
            return
        if self._viewer is None and self._has_viewer:
            self._viewer = start_viewer(self._file)
        now = time.monotonic()
        self._due = now + max(LEAST_SECONDS, (now - began) / _SHARE)

    def close(self) -> None:
        """End the viewer, and delete what it read."""
        if self._viewer is not None:
            self._viewer.terminate()
            try:
                self._viewer.wait(5.0)
            except subprocess.TimeoutExpired:
                self._viewer.kill()
                self._viewer.wait()
            say("The viewer is closed; `mien view` shows the finished avatar")
        shutil.rmtree(self._folder, ignore_errors=True)


def start_viewer(file: Path) -> "subprocess.Popen[bytes]":
    """Start a viewer of a file, with one thread and lower priority. Its first line is the address to open."""
    environment = {**os.environ, PARENT_VARIABLE: str(os.getpid()), "MIEN_THREADS": "1"}
    command = [sys.executable, "-m", "mien.cli", "view", str(file), "--follow"]
    viewer = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL)
    lower_priority(viewer.pid, 5)
    return viewer
