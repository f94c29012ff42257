"""Training: sequences and a method's config in, an avatar out."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.training.frames import held_out
    from mien.training.run import (
        check_data,
        check_run,
        check_untouched,
        outdated_sequences,
        read_curves,
        read_face_track,
        read_run_config,
        read_training_summary,
        run_camera,
        write_imported_run,
    )
    from mien.training.sequence import Sequence, read_sequence
    from mien.training.settings import MAIN_SETTINGS, PRESETS, Preset, Split, TrainSettings, check_held_out
    from mien.training.trainer import train
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "frames": ["held_out"],
            "run": [
                "check_data",
                "check_run",
                "check_untouched",
                "outdated_sequences",
                "read_curves",
                "read_face_track",
                "read_run_config",
                "read_training_summary",
                "run_camera",
                "write_imported_run",
            ],
            "sequence": ["Sequence", "read_sequence"],
            "settings": ["MAIN_SETTINGS", "PRESETS", "Preset", "Split", "TrainSettings", "check_held_out"],
            "trainer": ["train"],
        },
    )

__all__ = [
    "MAIN_SETTINGS",
    "PRESETS",
    "Preset",
    "Sequence",
    "Split",
    "TrainSettings",
    "check_data",
    "check_held_out",
    "check_run",
    "check_untouched",
    "held_out",
    "outdated_sequences",
    "read_curves",
    "read_face_track",
    "read_run_config",
    "read_sequence",
    "read_training_summary",
    "run_camera",
    "train",
    "write_imported_run",
]
