"""`mien create`."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.capture import CaptureSettings
from mien.commands.options import TrainOptions
from mien.tracking import TrackingSettings
from mien.workspace import Workspace


@dataclass(frozen=True)
class Command:
    """A video in; an avatar, metrics and a report out. Stopped at any time, the same command goes on where it was."""

    video: Annotated[Path, tyro.conf.Positional]
    """A video file, or a folder of pictures in order."""
    out: Path
    """Workspace folder to make or to go on with."""
    name: str | None = None
    """Name of the sequence (default: the video's name)."""
    run_name: Annotated[str | None, tyro.conf.arg(name="run")] = None
    """Name of the run (default: the method's)."""
    face_model: str = "anny"
    """See `mien face-models`."""
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = field(default_factory=TrainOptions)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)

    def run(self) -> None:
        """All stages, each skipped if its result is current."""
        from mien.commands.stages import capture_stage, evaluation_stage, sequence_name, tracking_stage, training_stage
        from mien.progress import say

        began = time.monotonic()
        method, settings = self.options.method_config(), self.options.settings()
        workspace, run = Workspace(self.out), self.run_name or self.options.method
        sequence_name(self.video, run)
        names = capture_stage(workspace, self.video, self.name, self.capture)
        for name in names:
            tracking_stage(workspace, name, self.face_model, self.tracking)
        training_stage(workspace, names, run, method, settings)
        if settings.split != "none":
            evaluation_stage(workspace, run)
        say(f"Done in {time.monotonic() - began:.0f} s. Next: mien render {self.out} --out turntable.mp4")
