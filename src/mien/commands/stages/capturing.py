"""Video -> Capture, as the command line runs it."""

import shutil
from pathlib import Path

from mien.capture import CaptureSettings, capture_video, read_capture_hash
from mien.commands.stages.names import sequence_name
from mien.progress import say
from mien.tracking import (
    scoring_exists,
)
from mien.workspace import Workspace


def capture_stage(workspace: Workspace, video: Path, name: str | None, settings: CaptureSettings) -> list[str]:
    """Capture a video into the workspace; returns the names of its sequences (one for each part)."""
    name = sequence_name(video, name)
    folder = workspace.sequence_dir(name)
    before = read_capture_hash(folder / "capture") if (folder / "capture" / "capture.json").is_file() else None
    capture = capture_video(video, folder / "capture", settings, name)
    if before not in (None, read_capture_hash(folder / "capture")) and scoring_exists(folder / "scoring"):
        say(f"{name}: the pictures changed, so the scoring mask is made anew")
        shutil.rmtree(folder / "scoring")
    found = int(capture.valid.any(axis=1).sum())
    say(f"{name}: {capture.timesteps} frames of {capture.width}x{capture.height}, a face in {found} of them")
    return [name]
