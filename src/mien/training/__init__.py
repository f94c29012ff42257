"""Training: sequences and a method's config in, an avatar out."""

from mien.training.run import read_curves, read_run_config, read_training_summary, run_camera
from mien.training.sequence import Sequence, read_sequence
from mien.training.settings import PRESETS, TrainSettings
from mien.training.split import Split, held_out
from mien.training.trainer import train

__all__ = [
    "PRESETS",
    "Sequence",
    "Split",
    "TrainSettings",
    "held_out",
    "read_curves",
    "read_run_config",
    "read_sequence",
    "read_training_summary",
    "run_camera",
    "train",
]
