"""`mien align`: from trackings to trackings that are aligned to a quick avatar."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.machine.devices import DeviceName, check_device
from mien.training.settings import AlignmentSettings, Split, TrainSettings, check_held_out

_SPLITS = ("blocks", "tail", "none")


@dataclass(frozen=True)
class Command:
    """Align the tracked faces of all frames to a quick avatar, which gives sharper avatars. `mien create` does this.

    A quick avatar is trained on the training frames, and the face parameters of every frame are fitted to it. Runs that
    were trained before have to be trained again, under another name. `mien track --again` undoes it.
    """

    workspace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Workspace folder."""
    sequences: tuple[str, ...] = ()
    """Names of the sequences (default: all tracked ones)."""
    split: Split = "blocks"
    """Frames that the quick avatar does not see: those that the run will hold out (blocks, tail or none)."""
    hold_out: tuple[str, ...] = ()
    """Whole sequences that it does not see. They are aligned to it as well."""
    hold_out_cameras: tuple[str, ...] = ()
    """Ids of cameras that nothing looks at, for captures with several cameras."""
    seed: int = 0
    """Seed of the random numbers. The same seed, data and settings give the same bytes."""
    device: DeviceName = "cpu"
    """Device for training the quick avatar. cpu: always the same bytes; cuda: an NVIDIA GPU, through gsplat."""
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        self.alignment.check()
        if self.alignment.when == "never":
            raise UserError("--alignment.when never: is for `mien create`; leave it out, as this command aligns")
        if self.split not in _SPLITS:
            raise UserError(f"--split {self.split}: give one of {', '.join(_SPLITS)}")
        check_device(self.device)
        workspace = open_workspace(self.workspace)
        check_held_out(workspace.pick_tracked(self.sequences, self.hold_out), self._training())

    def run(self) -> None:
        """Align, and write overlays and reports."""
        from mien.pipeline.align import run_alignment_stage
        from mien.pipeline.track import show_trackings

        workspace = open_workspace(self.workspace)
        names = workspace.pick_tracked(self.sequences, self.hold_out)
        run_alignment_stage(workspace, names, self.alignment, self._training())
        show_trackings(workspace, names, "auto")

    def _training(self) -> TrainSettings:
        settings = TrainSettings(
            split=self.split,
            seed=self.seed,
            device=self.device,
            held_out_sequences=tuple(sorted(set(self.hold_out))),
            held_out_cameras=tuple(sorted(set(self.hold_out_cameras))),
        )
        settings.check()
        return settings
