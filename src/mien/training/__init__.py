"""Training: sequences and a method's config in, an avatar out."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.training.alignment import align
    from mien.training.alignment_settings import AlignmentSettings
    from mien.training.footage.filmed import confidence_picture, filmed_words, read_coverage
    from mien.training.footage.frames import held_out
    from mien.training.footage.sequence import Sequence, read_sequence
    from mien.training.frame_gains import GAINS, lit, read_gains
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
    from mien.training.splits.benchmark import (
        BENCHMARK_SPLIT,
        HIDDEN_CAMERAS,
        TEST_CAMERAS,
        TEST_SEQUENCES,
        TRAINING_CAMERA,
        with_benchmark_split,
    )
    from mien.training.splits.named import NAMED_SPLIT, NamedSplit, split_by_name, with_named_split
    from mien.training.splits.own import OWN_SPLIT, OwnSplit, ranges_of, read_own_split, with_own_split, write_own_split
    from mien.training.trainer import train
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "AlignmentSettings",
    "GAINS",
    "BENCHMARK_SPLIT",
    "HIDDEN_CAMERAS",
    "MAIN_SETTINGS",
    "NAMED_SPLIT",
    "OWN_SPLIT",
    "PRESETS",
    "NamedSplit",
    "OwnSplit",
    "TEST_CAMERAS",
    "TEST_SEQUENCES",
    "TRAINING_CAMERA",
    "Preset",
    "Sequence",
    "Split",
    "TrainSettings",
    "align",
    "check_data",
    "check_held_out",
    "check_run",
    "check_untouched",
    "confidence_picture",
    "doubly_held_out",
    "filmed_range",
    "filmed_words",
    "held_out",
    "lit",
    "outdated_sequences",
    "ranges_of",
    "read_coverage",
    "read_curves",
    "read_face_track",
    "read_gains",
    "read_own_split",
    "read_run_config",
    "read_sequence",
    "read_training_summary",
    "run_camera",
    "split_by_name",
    "train",
    "with_benchmark_split",
    "with_named_split",
    "with_own_split",
    "write_imported_run",
    "write_own_split",
]
