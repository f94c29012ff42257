"""`mien track`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.tracking import TrackingSettings
from mien.workspace import open_workspace


@dataclass(frozen=True)
class Command:
    """Fit the face model to a captured sequence: DIR/sequences/NAME/tracking with overlay.mp4 and a residual report."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Workspace folder."""
    sequence: str | None = None
    """Which sequence (default: the only one)."""
    face_model: str = "anny"
    """See `mien face-models`."""
    again: bool = False
    """Track again even if nothing changed. The scoring mask stays as it is."""
    settings: Annotated[TrackingSettings, tyro.conf.arg(name="tracking")] = field(default_factory=TrackingSettings)

    def run(self) -> None:
        """Track and write overlay and report."""
        from mien.commands.stages import tracking_stage

        workspace = open_workspace(self.workspace)
        name = workspace.pick_sequence(self.sequence)
        tracking_stage(workspace, name, self.face_model, self.settings, again=self.again)
