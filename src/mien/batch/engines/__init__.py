"""Engines start rows: an adapter for each, behind one function.

An engine takes the work (a function of a row that pickle can carry), the rows and the options. It tries every row once
and yields each row with what the work returned, in the order in which they end. A row that fails does not stop others.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.batch.plan import Row

Work = Callable[[Row], Any]


@dataclass(frozen=True)
class EngineOptions:
    """Options of all engines."""

    root: Path
    """Folder of the batch."""
    jobs: int = 0
    """Largest number of rows at once. 0 leaves it to the engine."""
    threads: int = 0
    """Threads of each row. 0 leaves it to the engine."""
    gpus: float = 0.0
    """GPUs of each row."""
    minutes: int = 0
    """Time limit of a row in minutes, for Slurm. 0 derives it from finished rows."""
    partition: str = ""
    """Partition of Slurm."""
    address: str = ""
    """Address of a Ray cluster."""


Engine = Callable[[Work, Sequence[Row], EngineOptions], Iterator[tuple[Row, Any]]]
PLACES = {
    "local": "mien.batch.engines.local:run",
    "slurm": "mien.batch.engines.slurm:run",
    "ray": "mien.batch.engines.on_ray:run",
}
"""Name of an engine -> where its function is."""
EARLIER = {"slurm": "mien.batch.engines.slurm:wait_for_earlier"}
"""Name of an engine whose rows go on when the driver ends -> where the function is that waits for them."""
