"""`mien capture`: from a video to a capture."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.capture import CaptureSettings
from mien.workspace import Workspace, check_new_workspace


@dataclass(frozen=True)
class Command:
    """Turn a video of one person into frames, mattes and landmarks, in OUT/sequences/NAME/capture.

    Any video from a camera or phone works: upright or turned, HDR, with a variable frame rate, of any length. A video
    with cuts becomes the sequences NAME-1, NAME-2, ... A stopped command continues where it was if you run it again.

    Film half a minute or more, in even light, with the whole head in the picture: look around, talk, make faces.

    Example: mien capture me.mp4 --out out/me, then mien track out/me
    """

    video: Annotated[Path, tyro.conf.Positional]
    """A video file, or a folder of pictures in order."""
    out: Path
    """Workspace folder of the person. It may be new, or hold other videos of the same person."""
    name: str | None = None
    """Name of the sequence (default: the video's name)."""
    replace: bool = False
    """Replace a sequence of the same name that was made from another video."""
    settings: Annotated[CaptureSettings, tyro.conf.arg(name="capture")] = field(default_factory=CaptureSettings)

    def check(self) -> None:
        """Check options and paths without the libraries that capture."""
        from mien.commands.stages.names import sequence_names

        sequence_names([self.video], () if self.name is None else (self.name,))
        self.settings.check()
        check_new_workspace(self.out)

    def run(self) -> None:
        """Capture the video and report what was found."""
        from mien.commands.stages.capturing import run_capture_stage

        run_capture_stage(Workspace(self.out), self.video, self.name, self.settings, self.replace)
