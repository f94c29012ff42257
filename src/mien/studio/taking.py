"""What can be taken away of a person, each with one line that says where it opens. `mien export` writes the files."""

import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from mien.disk.reading import check_unlinked
from mien.errors import UserError

_SECONDS = 600
_exporting = threading.Lock()
"""Held by the one export that runs, since each needs memory and all threads."""


@dataclass(frozen=True)
class Taking:
    """Something that can be taken away."""

    title: str
    file: str
    """Its name in the workspace; {run} stands for the run."""
    opens: str
    """Where it opens, in one line."""
    options: tuple[str, ...] | None = ()
    """Options of `mien export`; None for what `mien create` has written."""


TAKINGS = {
    "page": Taking("Page", "me.html", "Opens in every browser, from a disk or a mail. One file, no network.", None),
    "webcam": Taking("Webcam page", "be_me.html", "The same, driven by a camera. Nothing leaves it.", ("--webcam",)),
    "film": Taking("Video", "me.mp4", "Plays everywhere: five seconds of the avatar.", None),
    "glb": Taking("GLB", "me.glb", "Opens in Blender, Unity, Unreal and Godot, with its expressions."),
    "mien": Taking("MIEN", "me.mien", "Opens with mien, in Python and in pages of your own. All of the avatar."),
    "splats": Taking("Splats", "me.ply", "Opens in SuperSplat and other viewers of Gaussian splats. One pose."),
    "report": Taking("Report", "runs/{run}/report.html", "Opens in a browser: how good it is, in figures.", None),
}


def place_of(folder: Path, run: str, kind: str) -> Path | None:
    """The file of a kind, if it is there and no older than the avatar."""
    path = folder / TAKINGS[kind].file.format(run=run)
    for each in (path, *path.parents[: len(path.relative_to(folder).parts) - 1]):
        check_unlinked(each)
    trained = folder / "runs" / run / "avatar"
    return path if path.is_file() and path.stat().st_mtime >= trained.stat().st_mtime else None


def take(folder: Path, run: str, kind: str) -> Path:
    """Return the file of a kind, which is written first if it is missing."""
    taking = TAKINGS[kind]
    with _exporting:
        found = place_of(folder, run, kind)
        if found is None and taking.options is not None:
            words = ("export", str(folder), "--run", run, "--out", str(folder / taking.file), *taking.options)
            command = [sys.executable, "-m", "mien.cli", *words]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
            except subprocess.TimeoutExpired:
                raise UserError(f"{taking.title}: took more than {_SECONDS} s; try again later") from None
            if done.returncode:
                lines = [line for line in done.stderr.splitlines() if line.strip()] or ["it ended without a word"]
                raise UserError(f"{taking.title}: {lines[-1].removeprefix('mien: ')}")
            found = place_of(folder, run, kind)
    if found is None:
        raise UserError(f"{taking.title}: was not written, as the messages of the making say; make the avatar again")
    return found
