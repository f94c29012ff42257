"""Training: sequences and a method's config in, an avatar out."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.training.footage import (
        NAMED_SPLIT,
        NamedSplit,
        Sequence,
        confidence_picture,
        filmed_words,
        held_out,
        read_coverage,
        read_sequence,
        split_by_name,
        with_named_split,
    )
    from mien.training.run import (
        check_data,
        check_run,
        check_untouched,
        filmed_range,
        outdated_sequences,
        read_curves,
        read_face_track,
        read_run_config,
        read_training_summary,
        run_camera,
        write_imported_run,
    )
    from mien.training.settings import (
        MAIN_SETTINGS,
        PRESETS,
        Preset,
        Split,
        TrainSettings,
        check_held_out,
        doubly_held_out,
    )
    from mien.training.trainer import train
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "MAIN_SETTINGS",
    "NAMED_SPLIT",
    "PRESETS",
    "NamedSplit",
    "Preset",
    "Sequence",
    "Split",
    "TrainSettings",
    "check_data",
    "check_held_out",
    "check_run",
    "check_untouched",
    "confidence_picture",
    "doubly_held_out",
    "filmed_range",
    "filmed_words",
    "held_out",
    "outdated_sequences",
    "read_coverage",
    "read_curves",
    "read_face_track",
    "read_run_config",
    "read_sequence",
    "read_training_summary",
    "run_camera",
    "split_by_name",
    "train",
    "with_named_split",
    "write_imported_run",
]
