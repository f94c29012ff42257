"""`mien capture`: from a video, or the videos of several calibrated cameras, to a capture."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.capture.settings import CaptureSettings
from mien.disk.workspace import Workspace, check_new_workspace
from mien.errors import UserError
from mien.pipeline.names import check_sources


@dataclass(frozen=True)
class Command:
    """Turn a video of one person into frames, mattes and landmarks, in DIR/sequences/NAME/capture.

    Any video from a camera or phone works: upright or turned, HDR, with a variable frame rate, of any length. A video
    with cuts becomes the sequences NAME-1, NAME-2, ... A stopped command continues where it was if you run it again.

    Film half a minute or more, in even light, with the whole head in the picture: look around, talk, make faces.

    Example: mien capture me.mp4 --out out/me, then mien track out/me

    Several calibrated cameras that filmed at the same time become one sequence: mien capture rig/*.mp4 --calibration
    rig.json --name talk --out out/me
    """

    videos: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH [PATH ...]")]
    """A video file, or a folder of pictures in order. With --calibration, one for each camera, named by the camera's
    id, or one folder that holds them."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Workspace folder of the person. It may be new, or hold other videos of the same person."""
    name: str | None = None
    """Name of the sequence (default: the name of the video or folder)."""
    calibration: Path | None = None
    """The cameras that filmed the videos, as json (docs/using.md)."""
    replace: bool = False
    """Replace a sequence of the same name that was made from another video."""
    settings: Annotated[CaptureSettings, tyro.conf.arg(name="capture")] = field(default_factory=CaptureSettings)

    def check(self) -> None:
        """Check options and paths without the libraries that capture."""
        if self.calibration is None and len(self.videos) > 1:
            raise UserError(
                f"{self.videos[1]}: several videos become one capture only if their cameras are calibrated; add "
                "--calibration FILE, or capture one at a time"
            )
        self.settings.check()
        check_new_workspace(self.out)
        check_sources(self.videos, self._names, self.calibration)

    def run(self) -> None:
        """Capture the videos and report what was found."""
        from mien.pipeline.capture import run_capture_stage

        workspace = Workspace(self.out)
        run_capture_stage(workspace, self.videos, self._names, self.calibration, self.settings, self.replace)

    @property
    def _names(self) -> tuple[str, ...]:
        return () if self.name is None else (self.name,)
