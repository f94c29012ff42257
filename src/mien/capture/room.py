"""Say how much room a capture takes on disk, and refuse it before anything is written if there is not enough."""

import shutil
from pathlib import Path

from mien.capture.frame_files import FRAMES, MATTES, FrameLayout
from mien.disk.inside import remove_tree
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted

_PNG_SHARE = 0.5
"""Size of lossless PNGs relative to their pixels. Footage takes 0.2 to 0.5 of them, mattes almost nothing."""


def capture_bytes(layout: FrameLayout) -> int:
    """Estimate the room that a capture takes on disk, in bytes: the decoded pixels and the PNGs."""
    frames, mattes = layout.raw_size(FRAMES), layout.raw_size(MATTES)
    return frames + mattes + round(_PNG_SHARE * frames)


def check_room(layout: FrameLayout, name: str, out: Path) -> None:
    """Say how much room a capture takes, before its pictures are written. Files of an interrupted run count as room.

    Args:
        layout: the frames to come, in the folder for unfinished work.
        name: name of the sequence.
        out: the capture's folder, for the message.
    """
    cameras, size = len(layout.camera_ids), f"{layout.width}x{layout.height}"
    what = f"{counted(layout.timesteps, 'frame')} of {size}" + (f" by {cameras} cameras" if cameras > 1 else "")
    needed = capture_bytes(layout)
    free = shutil.disk_usage(layout.folder).free + _used(layout.folder)
    if free < needed:
        if not any(entry.is_dir() for entry in layout.folder.iterdir()):
            remove_tree(layout.folder)  # no picture is in it
        raise UserError(
            f"{out}: {what} take about {_text(needed)} on disk, and there are {_text(free)} left; free disk space, "
            "choose another --out, or take less (--capture.max-frames, --capture.stride, --capture.size)"
        )
    say(f"{name}: {what} take about {_text(needed)} on disk")


def _used(folder: Path) -> int:
    """Bytes on disk of the files in a folder. Raw files may have holes."""
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def _text(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{max(1, round(count / 1e6))} MB"
