"""TrainSettings: what a run is, apart from the method; presets are plain instances."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mien.devices import DeviceName
from mien.errors import UserError

Split = Literal["blocks", "tail", "none"]
"""Which timesteps are held out (`mien.training.split`)."""


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training run. The method's own (losses, rates, density control) are in its config."""

    steps: int = 15_000
    """Optimiser steps, one frame each; all schedules stretch with it."""
    split: Split = "blocks"
    """What is held out: every fifth block of 10 timesteps, the last 20 % (`tail`), or nothing."""
    background: Literal["white", "random"] = "white"
    """What pictures are composited on. A random colour each step keeps Gaussians from painting the background, which
    can show as white needles in new poses; it costs 0.1 to 0.4 dB over white."""
    resolution: int = 0
    """Longer side of the training pictures in pixels; 0 for the capture's own."""
    seed: int = 0
    """Same seed, same settings, same data: same bytes (on a CPU)."""
    threads: int = 0
    """Threads of native operations; 0 for MIEN_THREADS or all cores. Results do not depend on it."""
    device: DeviceName = "cpu"
    """Where training runs. On `cuda` (through gsplat) the same seed does not give the same bytes."""
    checkpoint_every: int = 1_000
    """Steps between checkpoints."""
    record_every: int = 10
    """Steps between entries of the curves."""
    held_out_sequences: tuple[str, ...] = ()
    """Whole sequences that are not trained on; the split divides the others."""
    held_out_cameras: tuple[str, ...] = ()
    """Camera ids that are not trained on, in any sequence."""

    @property
    def holds_out(self) -> bool:
        """Whether anything is left to score."""
        return self.split != "none" or bool(self.held_out_sequences or self.held_out_cameras)


PRESETS = {
    "draft": TrainSettings(steps=8_000),
    "standard": TrainSettings(),
}
"""From quick to good."""


def check_held_out(names: Sequence[str], settings: TrainSettings) -> None:
    """Find that the sequences to be held out are among a run's, and that others remain.

    Raises:
        UserError: they are not, or nothing remains.
    """
    unknown = [name for name in settings.held_out_sequences if name not in names]
    if unknown:
        raise UserError(f"--hold-out {unknown[0]}: no such sequence in this run; there are: {', '.join(names)}")
    if set(names) <= set(settings.held_out_sequences):
        raise UserError(f"--hold-out {' '.join(settings.held_out_sequences)}: leaves no sequence to train on")
