"""Engines start rows: an adapter for each, behind one function.

An engine takes the work (a function of a row that pickle can carry), the rows and the options. It tries every row once
and yields each row with what the work returned, in the order in which they end. A row that fails does not stop others.

Other packages add engines by entry points of the group `mien.engines` (CONTRIBUTING.md, "Add an engine").
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.batch.plan import Row
from mien.errors import UserError
from mien.plugins import named, plugin, plugin_names

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


Run = Callable[[Work, Sequence[Row], EngineOptions], Iterator[tuple[Row, Any]]]


@dataclass(frozen=True)
class Engine:
    """An engine starts rows. Its functions are imported at their first use, because they need packages of their own."""

    run_place: str
    """"MODULE:NAME" of its function, a `Run`."""
    options: tuple[str, ...] = ()
    """Options that it heeds, of gpus, partition, time, ray_address and store of `mien batch`. Others are refused."""
    packages: tuple[str, ...] = ()
    """Modules that it needs. One that is missing is told before rows are read."""
    wait_place: str = ""
    """"MODULE:NAME" of a function of the batch's folder that waits for rows of an earlier driver. Empty if rows end
    with their driver."""

    @property
    def run(self) -> Run:
        """The function that tries every row once."""
        return _imported(self.run_place)

    def wait_for_earlier(self, root: Path) -> None:
        """Wait for rows that an earlier driver has left running."""
        if self.wait_place:
            _imported(self.wait_place)(root)


ENGINES = {
    "local": Engine("mien.batch.engines.local:run", ("store",)),
    "slurm": Engine(
        "mien.batch.engines.slurm:run",
        ("gpus", "partition", "time"),
        ("submitit",),
        "mien.batch.engines.slurm:wait_for_earlier",
    ),
    "ray": Engine("mien.batch.engines.on_ray:run", ("gpus", "ray_address", "store"), ("ray",)),
}
"""Mien's own engines by name."""
_GROUP = "mien.engines"
"""Group of entry points of other packages. Batches on one of mien's own engines do not read it."""


def engine_names() -> list[str]:
    """The names of all engines: mien's own, then those that other packages add. None of these is imported."""
    return [*ENGINES, *(name for name in plugin_names(_GROUP) if name not in ENGINES)]


def engine_named(name: str) -> Engine:
    """The engine of a name. Other packages are asked only if it is none of mien's own."""
    engine = ENGINES.get(name) or plugin(_GROUP, name, Engine)
    if engine is None:
        raise UserError(f"no engine {name!r}; give one of {', '.join(engine_names())}, or install what adds it")
    return engine


def _imported(place: str) -> Any:
    """The function at a place "MODULE:NAME". What fails in another package is not reported as a bug in mien."""
    try:
        return named(place)
    except (Exception, SystemExit) as error:  # whatever the code of another package raises
        if place.startswith("mien."):
            raise
        remedy = "update or uninstall the package of this engine"
        raise UserError(f"{place}: cannot be imported ({error!r}); {remedy}") from error
