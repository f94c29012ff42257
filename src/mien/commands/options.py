"""What several sub-commands ask: which method, how thorough, which settings in detail."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mien.devices import DeviceName, check_device
from mien.errors import UserError
from mien.training import PRESETS, Split, TrainSettings
from mien.workspace import open_workspace

if TYPE_CHECKING:
    import mien.avatar

MethodName = Literal["gaussian_avatars", "headgas", "mono_gaussian_avatar"]
"""The keys of `mien.avatar.METHODS` (a test compares them): options are read before torch is imported."""
Preset = Literal["draft", "standard"]


@dataclass(frozen=True)
class TrainOptions:
    """The dials of training; everything else is the preset's and the method's own."""

    method: MethodName = "gaussian_avatars"
    """How the avatar is made (docs/results.md compares them)."""
    preset: Preset = "standard"
    """draft: minutes; standard: the figures of docs/results.md."""
    split: Split = "blocks"
    """What is held out for scoring: every fifth block of 10 frames, the last 20 % (tail), or nothing (none)."""
    background: Literal["white", "random"] = "white"
    """What training pictures lie over. random: for transparent renderings (no white in skin and outlines); it costs 0.1
    to 0.4 dB over white."""
    steps: int = 0
    """Optimiser steps instead of the preset's (schedules stretch with it); 0 for the preset's."""
    seed: int = 0
    """Same seed, same data, same settings: the same bytes."""
    hold_out: tuple[str, ...] = ()
    """Whole sequences that are not trained on, only scored."""
    hold_out_cameras: tuple[str, ...] = ()
    """Ids of cameras that are not trained on, only scored (captures with several cameras)."""
    device: DeviceName = "cpu"
    """Where training runs. cpu: the same bytes every time; cuda: an NVIDIA GPU, through gsplat (docs/using.md
    says how to install it); auto: a GPU where there is one. A run may be resumed on the other."""
    face_tuning: bool = True
    """Training also corrects the tracking of the frames it sees (held-out frames get what lies beside them); with
    --no-face-tuning it does not."""

    def settings(self) -> TrainSettings:
        """The preset with these changes.

        Raises:
            UserError: the number of steps is negative; CUDA is asked for without gsplat.
        """
        check_device(self.device)
        if self.steps < 0:
            raise UserError(f"--steps {self.steps}: give a positive number, or 0 for the preset's")
        preset = PRESETS[self.preset]
        return replace(
            preset,
            split=self.split,
            background=self.background,
            seed=self.seed,
            steps=self.steps or preset.steps,
            device=self.device,
            held_out_sequences=tuple(sorted(set(self.hold_out))),
            held_out_cameras=tuple(sorted(set(self.hold_out_cameras))),
        )

    def method_config(self) -> "mien.avatar.MethodConfig":
        """The method's settings."""
        from mien.avatar import method_named

        config = method_named(self.method).config()
        return replace(config, face_tuning=replace(config.face_tuning, enabled=self.face_tuning))


def check_driver(by: Path, sequence: str | None, fps: float | None = None) -> None:
    """Find before any work that somebody can be followed there: a workspace with that sequence, or a file.

    Raises:
        UserError: it is not there, has no such sequence, or none to choose from, or a frame rate that is not asked for.
    """
    suffix = by.suffix.lower() if by.is_file() else ""
    if fps is not None and (suffix != ".csv" or not 0 < fps <= 1000):
        raise UserError(f"--fps {fps:g}: only the timecode of a .csv has one to give, above 0 and up to 1000")
    if not by.exists():
        raise UserError(f"{by}: no such file or folder; give a workspace, a video, a csv of Live Link Face, or a json")
    if suffix in (".csv", ".json") and sequence is not None:
        raise UserError(f"--sequence {sequence}: {by} has none to choose from; leave it out")
    if not by.is_file():
        open_workspace(by).pick_sequence(sequence)
