"""`mien track`: from captures to trackings."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mien.disk.workspace import open_workspace
from mien.tracking.settings import ScoringSettings, TrackingSettings


@dataclass(frozen=True)
class Command:
    """Fit the face model to all sequences of a workspace. Writes DIR/sequences/NAME/tracking, an overlay and a report.

    A workspace is one person, so its sequences are tracked together, with one identity. If a sequence is added, all of
    them are tracked again. Give --hold-out again then, if you used it.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    face_model: str = "anny"
    """Name of a face model (see `mien face-models`), or a .npz or .pkl file in FLAME's schema."""
    hold_out: tuple[str, ...] = ()
    """Sequences to track apart. The others alone decide the person's shape, texture and light and the focal length;
    then only the motion of these is fitted. Without it, all sequences decide."""
    again: bool = False
    """Track again even if nothing has changed. The scoring masks stay as they are."""
    preview: bool = False
    """Show the fit while it runs, in DIR/tracking_preview.html. Open that page in a browser; it is updated every few
    seconds."""
    overlay: Literal["auto", "all", "none"] = "auto"
    """Frames in overlay.mp4: all, every n-th, at most 120 (auto), or none."""
    settings: Annotated[TrackingSettings, tyro.conf.arg(name="tracking")] = field(default_factory=TrackingSettings)
    scoring: ScoringSettings = field(default_factory=ScoringSettings)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        self.settings.check()
        workspace = open_workspace(self.workspace)
        for name in self.hold_out:
            workspace.pick_sequence(name)

    def run(self) -> None:
        """Track, and write overlays and reports."""
        from mien.pipeline.track import run_tracking_stage

        run_tracking_stage(
            open_workspace(self.workspace),
            self.face_model,
            self.settings,
            self.again,
            self.overlay,
            self.preview,
            self.hold_out,
            self.scoring,
        )
