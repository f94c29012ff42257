"""What several sub-commands ask: which method, how thorough, which settings in detail."""

from dataclasses import dataclass, replace
from typing import Literal

from mien.avatar import MethodConfig, method_named
from mien.errors import UserError
from mien.training import PRESETS, TrainSettings
from mien.training.split import Split

Preset = Literal["draft", "standard"]


@dataclass(frozen=True)
class TrainOptions:
    """The dials of training; everything else is the preset's and the method's own."""

    method: str = "gaussian_avatars"
    """gaussian_avatars, headgas or mono_gaussian_avatar."""
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
    face_tuning: bool = True
    """Whether training also corrects the tracking of the frames it sees (held-out frames get what lies beside them)."""

    def settings(self) -> TrainSettings:
        """The preset with these changes.

        Raises:
            UserError: the number of steps is negative.
        """
        if self.steps < 0:
            raise UserError(f"--steps {self.steps}: give a positive number, or 0 for the preset's")
        preset = PRESETS[self.preset]
        return replace(
            preset,
            split=self.split,
            background=self.background,
            seed=self.seed,
            steps=self.steps or preset.steps,
            held_out_sequences=tuple(sorted(set(self.hold_out))),
            held_out_cameras=tuple(sorted(set(self.hold_out_cameras))),
        )

    def method_config(self) -> MethodConfig:
        """The method's settings.

        Raises:
            UserError: there is no such method.
        """
        config = method_named(self.method).config()
        return replace(config, face_tuning=replace(config.face_tuning, enabled=self.face_tuning))
