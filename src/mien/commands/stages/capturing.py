"""From a video to captures, as the command line runs it."""

from pathlib import Path

from mien.capture import CaptureSettings, capture_video_parts
from mien.commands.stages.names import sequence_name
from mien.progress import say
from mien.storage import check_writable
from mien.workspace import Workspace


def run_capture_stage(
    workspace: Workspace, video: Path, name: str | None, settings: CaptureSettings, replace: bool = False
) -> list[str]:
    """Capture a video into the workspace; return the names of its sequences, one for each part.

    Raises:
        UserError: the video is bad, or without `replace` a sequence of that name was made from another source.
    """
    name = sequence_name(video, name)
    check_writable(workspace.root, folder=True)
    captures = capture_video_parts(video, workspace.root / "sequences", settings, name, replace)
    for capture in captures:
        found, blurred = int(capture.valid.any(axis=1).sum()), int((capture.valid & ~capture.usable).sum())
        say(
            f"{capture.name}: {capture.timesteps} frames of {capture.width}x{capture.height}, a face in {found} of them"
            + (f", blurred in {blurred}" if blurred else "")
        )
    return [capture.name for capture in captures]
