"""Training: sequences and a method's config in, an avatar out."""

from mien.training.frames import check_held_out
from mien.training.run import (
    check_data,
    check_run,
    outdated_sequences,
    read_curves,
    read_run_config,
    read_training_summary,
    run_camera,
)
from mien.training.sequence import Sequence, read_sequence
from mien.training.settings import PRESETS, TrainSettings
from mien.training.split import Split, held_out
from mien.training.trainer import train

__all__ = [
    "PRESETS",
    "Sequence",
    "Split",
    "TrainSettings",
    "check_data",
    "check_held_out",
    "check_run",
    "held_out",
    "outdated_sequences",
    "read_curves",
    "read_run_config",
    "read_sequence",
    "read_training_summary",
    "run_camera",
    "train",
]
