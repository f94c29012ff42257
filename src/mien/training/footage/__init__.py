"""The frames that an avatar is trained on: sequences, splits, targets, and which sides of the head they show."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.training.footage.clothes import FOREIGN, clothes_digest, clothes_mask, packed_clothes, read_clothes
    from mien.training.footage.constants import FOOTAGE
    from mien.training.footage.coverage import (
        Coverage,
        drawn_share,
        measure_coverage,
        representative_frames,
        smoothstep,
    )
    from mien.training.footage.filmed import (
        confidence_picture,
        filmed_words,
        filmed_yaws,
        read_coverage,
        with_shown_angles,
        write_coverage,
    )
    from mien.training.footage.foreground import foreground_colors
    from mien.training.footage.frames import (
        Frame,
        FrameOrder,
        background_at,
        camera_extent,
        cover_random,
        crop_random,
        density_random,
        evenly_spread,
        expression_rarity,
        held_out,
        held_out_of,
        resolved,
        side_random,
        spread_frames,
        training_frames,
    )
    from mien.training.footage.hidden import hidden_triangles, inside_triangles
    from mien.training.footage.mesh_colors import sample_picture, vertex_colors
    from mien.training.footage.sequence import Sequence, Target, Targets, composite, read_sequence, sequence_of
    from mien.training.splits.benchmark import (
        BENCHMARK_SPLIT,
        HIDDEN_CAMERAS,
        TEST_CAMERAS,
        TEST_SEQUENCES,
        TRAINING_CAMERA,
        with_benchmark_split,
    )
    from mien.training.splits.named import (
        DRIVING,
        NAMED_SPLIT,
        NamedSplit,
        driving_sequences,
        split_by_name,
        with_named_split,
    )
    from mien.training.splits.own import (
        OWN_SPLIT,
        OwnSplit,
        imported_from,
        ranges_of,
        read_own_split,
        with_own_split,
        write_own_split,
    )
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "BENCHMARK_SPLIT",
    "Coverage",
    "DRIVING",
    "FOOTAGE",
    "FOREIGN",
    "Frame",
    "FrameOrder",
    "HIDDEN_CAMERAS",
    "NAMED_SPLIT",
    "NamedSplit",
    "OWN_SPLIT",
    "OwnSplit",
    "Sequence",
    "TEST_CAMERAS",
    "TEST_SEQUENCES",
    "TRAINING_CAMERA",
    "Target",
    "Targets",
    "side_random",
    "background_at",
    "camera_extent",
    "clothes_digest",
    "clothes_mask",
    "composite",
    "confidence_picture",
    "crop_random",
    "density_random",
    "cover_random",
    "drawn_share",
    "driving_sequences",
    "evenly_spread",
    "expression_rarity",
    "filmed_words",
    "filmed_yaws",
    "foreground_colors",
    "held_out",
    "held_out_of",
    "hidden_triangles",
    "imported_from",
    "inside_triangles",
    "measure_coverage",
    "packed_clothes",
    "ranges_of",
    "read_clothes",
    "read_coverage",
    "read_own_split",
    "read_sequence",
    "resolved",
    "sample_picture",
    "sequence_of",
    "smoothstep",
    "split_by_name",
    "spread_frames",
    "representative_frames",
    "training_frames",
    "vertex_colors",
    "with_benchmark_split",
    "with_named_split",
    "with_own_split",
    "with_shown_angles",
    "write_coverage",
    "write_own_split",
]
