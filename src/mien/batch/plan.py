"""The plan of a batch and the state of its rows, on disk.

DIR/plan.json has all rows. DIR/states/NAME.json has what became of a row; only the process that holds the lock of that
file writes it. DIR/logs/NAME.log has what the row's commands printed, and DIR/rows/NAME is its workspace.
"""

import hashlib
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal

from mien.disk.config import Range, check_ranges, decode
from mien.disk.files import read_json, remove_leftovers, write_atomically, write_json
from mien.disk.locks import BeingWrittenError, hold
from mien.disk.reading import check_unlinked, expect_whole, inside
from mien.errors import UserError

PLAN, STATE = ("mien.batch", 1), ("mien.batch-row", 1)
WORKSPACE = "{workspace}"
"""Stands for the row's workspace in the words of its steps."""
ROWS = "{rows}"
"""Stands for the folder of the workspaces of all rows."""
_AGAIN = "run `mien batch TABLE --out DIR` again"
_Number = Annotated[float, Range(0, 1e15)]
"""A number of which many can be added up."""
_COUNT = Range(0, 100_000)


@dataclass(frozen=True)
class Row:
    """A row of the table: one person, one workspace."""

    name: str
    steps: tuple[tuple[str, ...], ...]
    """Commands of mien in their order, each without the word `mien`."""
    labels: dict[str, str] = field(default_factory=dict)
    """Further columns of the table, which come back in the results."""
    memory_mb: _Number = 2000.0
    """Memory that the row needs, in megabytes."""
    fingerprint: str = ""
    """Digest of the steps and of the sizes and times of the input files. A row that is done is done for this one."""
    first: bool = False
    """Whether the row has to end before others begin, which use what it makes."""


@dataclass(frozen=True)
class State:
    """The state of a row. `status` is that of its last try."""

    name: str
    status: Literal["running", "done", "failed"]
    """A row that says running, but whose lock is free, was interrupted."""
    fingerprint: str
    tries: int = 1
    host: str = ""
    """Machine and process of the last try."""
    began: _Number = 0.0
    """Begin of the last try, in seconds since 1970."""
    seconds: _Number = 0.0
    """Duration of the last try."""
    stages: dict[str, _Number] = field(default_factory=dict)
    """Seconds of each stage in the last try."""
    error: str = ""
    """The error in one line."""
    peak_mb: _Number = 0.0
    """Largest memory of the row's process, in megabytes."""
    mien: str = ""
    """Version of mien."""
    runs: tuple[dict[str, str | int | float | None], ...] = ()
    """Figures of each run."""


@dataclass(frozen=True)
class Options:
    """How the rows of a batch are run."""

    on: Literal["local", "slurm", "ray"] = "local"
    """The engine that runs the rows: processes of this machine, a Slurm cluster (submitit), or a Ray cluster."""
    retry: Annotated[int, _COUNT] = 2
    """How often a failed row is tried again."""
    jobs: Annotated[int, _COUNT] = 0
    """Largest number of rows at once. 0 means as many as memory and cores allow."""
    threads: Annotated[int, _COUNT] = 0
    """Threads of each row. 0 shares the cores out, or asks a cluster for two."""
    gpus: Annotated[float, Range(0, 64)] = 0.0
    """GPUs of each row, on Slurm and Ray."""
    partition: str = ""
    """Partition of Slurm."""
    time: Annotated[int, _COUNT] = 0
    """Time limit of a row in minutes, for Slurm. 0 means three times the longest finished row, at first a day."""
    ray_address: str = ""
    """Address of a Ray cluster (default: RAY_ADDRESS, or a Ray that is started here)."""
    store: str = ""
    """URL of a folder for the workspaces, such as s3://bucket/people, if nodes share no folder. Copied in and out."""
    program: str = ""
    """Command that runs a row on a node, such as "apptainer exec mien.sif mien batch-row". The folder of
    the batch follows it."""

    def check(self) -> None:
        """Check ranges, and that the program can be read."""
        check_ranges(self, lambda name: f"--{name.replace('_', '-')}")
        self.words_of_program()

    def words_of_program(self) -> tuple[str, ...]:
        """The words of the program; by default, `mien batch-row` by this Python."""
        try:
            return tuple(shlex.split(self.program)) or (sys.executable, "-m", "mien.cli", "batch-row")
        except ValueError as error:
            raise UserError(f"--program {self.program}: {error}; write it as in a shell") from None


Work = Callable[[Row], Any]
"""Runs a row, wherever an engine calls it. Pickle can carry it."""


@dataclass(frozen=True)
class Batch:
    """The folder of a batch."""

    root: Path

    def state_file(self, name: str) -> Path:
        """The file of a row's state. Its lock is the claim on the row."""
        return self.place("states", f"{name}.json")

    def log_file(self, name: str) -> Path:
        """The file that holds what the row's commands printed."""
        return self.place("logs", f"{name}.log")

    def workspace(self, name: str) -> Path:
        """The row's workspace."""
        return self.place("rows", name)

    def words(self, row: Row, step: Sequence[str]) -> list[str]:
        """The words of a step of a row, with its workspace in them."""
        places = {WORKSPACE: self.workspace(row.name), ROWS: self.root / "rows"}
        return [reduce(lambda text, mark: text.replace(mark, str(places[mark])), places, word) for word in step]

    def place(self, *names: str) -> Path:
        """The path of a folder of the batch, or of something in it. Somebody else may have filled it."""
        path = self.root
        for name in names:
            path = inside(path, name)
            check_unlinked(path)
        return path

    def read_plan(self) -> list[Row]:
        """The rows."""
        path = self.root / "plan.json"
        if not path.is_file():
            raise UserError(
                f"{self.root}: is not the folder of a batch (no plan.json); give the one that `mien batch TABLE --out` "
                "names"
            )
        content = read_json(path, *PLAN, remedy=_AGAIN, most=256 << 20)
        with expect_whole(path, _AGAIN):
            return [decode(Row, row, f"{path}: row", _AGAIN) for row in content["rows"]]

    def write_plan(self, rows: Sequence[Row]) -> None:
        """Write the rows."""
        text = json.dumps({"format": PLAN[0], "version": PLAN[1], "rows": [asdict(row) for row in rows]})
        write_atomically(self.root / "plan.json", lambda aside: aside.write_text(text, encoding="utf-8"))

    def read_state(self, name: str) -> State | None:
        """The state of a row, or None if it never began. A damaged file counts as a failed try."""
        path = self.state_file(name)
        try:
            content = read_json(path, *STATE, remedy=_AGAIN)
            del content["format"], content["version"]
            return decode(State, content, f"{path}: state", _AGAIN)
        except UserError as error:
            return State(name, "failed", "", error=str(error)) if path.exists() else None

    def read_states(self) -> dict[str, State]:
        """The states of all rows, by name. Damaged ones count as failed."""
        files = self.place("states").glob("[!.]*.json")
        found = ((file.stem, self.read_state(file.stem)) for file in files)
        return {name: state for name, state in found if state is not None}

    def write_state(self, state: State) -> None:
        """Write the state of a row. The caller holds its lock."""
        write_json(self.state_file(state.name), *STATE, asdict(state))

    def remove_leftovers(self, rows: Sequence[Row]) -> None:
        """Remove the temporary files and locks that killed processes of these rows left beside the states."""
        if any(self.place("states").glob(".*")):
            for row in rows:
                path = self.state_file(row.name)
                with suppress(BeingWrittenError), hold(path):  # the end of `hold` removes a lock
                    remove_leftovers(path)

    def is_done(self, row: Row) -> bool:
        """Whether the row is done with its present inputs."""
        state = self.read_state(row.name)
        return state is not None and state.status == "done" and state.fingerprint == row.fingerprint

    def tries(self, row: Row) -> int:
        """How often the row was tried with its present inputs."""
        state = self.read_state(row.name)
        return state.tries if state is not None and state.fingerprint == row.fingerprint else 0


def with_fingerprint(row: Row, inputs: Sequence[Path]) -> Row:
    """The row with the digest of its steps and of the sizes and times of its input files."""
    seen = [(str(path), status.st_size, status.st_mtime_ns) for path in inputs if (status := path.stat())]
    digest = hashlib.sha256(json.dumps([row.steps, seen]).encode()).hexdigest()[:32]
    return replace(row, fingerprint=digest)
