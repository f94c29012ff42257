"""Datasets: folders of other programs and laboratories, each with the file that recognises and reads it.

`registry` lists them and `dataset` says what one is. Readers use `arrays`, and `sequences` makes what they return.
`writing` puts that into a workspace.
"""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.datasets.arrays import read_arrays
    from mien.datasets.dataset import (
        Clip,
        Dataset,
        FilmedSequence,
        Findings,
        Footage,
        ReadSequence,
        TrackedSequence,
        TrainedAvatar,
    )
    from mien.datasets.registry import datasets, find_dataset, known_datasets, recognised
    from mien.datasets.sequences import filmed_sequence, tracked_sequence
    from mien.datasets.writing import write_sequence
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "Clip",
    "Dataset",
    "FilmedSequence",
    "Findings",
    "Footage",
    "ReadSequence",
    "TrackedSequence",
    "TrainedAvatar",
    "datasets",
    "filmed_sequence",
    "find_dataset",
    "known_datasets",
    "read_arrays",
    "recognised",
    "tracked_sequence",
    "write_sequence",
]
