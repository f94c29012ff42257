"""`mien capture`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.capture import CaptureSettings
from mien.workspace import Workspace


@dataclass(frozen=True)
class Command:
    """Turn a video into frames, mattes and landmarks: OUT/sequences/NAME/capture (NAME-1, NAME-2 if it cuts)."""

    video: Annotated[Path, tyro.conf.Positional]
    """A video file, or a folder of pictures in order."""
    out: Path
    """Workspace folder (one subject)."""
    name: str | None = None
    """Name of the sequence (default: the video's name)."""
    replace: bool = False
    """Whether a sequence of that name may be replaced that was made from another video."""
    settings: Annotated[CaptureSettings, tyro.conf.arg(name="capture")] = field(default_factory=CaptureSettings)

    def run(self) -> None:
        """Capture and say what was found."""
        from mien.commands.stages import capture_stage

        capture_stage(Workspace(self.out), self.video, self.name, self.settings, self.replace)
