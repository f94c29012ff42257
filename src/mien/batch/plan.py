"""The plan of a batch and the state of its rows, on disk.

DIR/plan.json has all rows. DIR/states/NAME.json has what became of a row; only the process that holds the lock of that
file writes it. DIR/logs/NAME.log has what the row's commands printed, and DIR/rows/NAME is its workspace.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mien.disk.files import expect_whole, read_json, remove_leftovers, write_atomically, write_json
from mien.disk.inside import check_unlinked, inside, is_one_line, is_plain_name
from mien.disk.locks import BeingWrittenError, hold
from mien.disk.reading import parse_json, read_bytes
from mien.errors import UserError

PLAN, STATE = ("mien.batch", 1), ("mien.batch-row", 1)
WORKSPACE = "{workspace}"
"""Stands for the row's workspace in the words of its steps."""
_STATUSES = ("running", "done", "failed")
_MAX_PLAN_BYTES, _MAX_STATE_BYTES = 256 << 20, 1 << 20
_MAX_NUMBER = 1e15
_COMPARED = 50
"""Number of characters by which leftovers are told, before `mien.disk.files` looks at them exactly."""
_AGAIN = "run `mien batch TABLE --out DIR` again"


@dataclass(frozen=True)
class Row:
    """A row of the table: one person, one workspace."""

    name: str
    steps: tuple[tuple[str, ...], ...]
    """Commands of mien in their order, each without the word `mien`."""
    labels: dict[str, str] = field(default_factory=dict)
    """Further columns of the table, which come back in the results."""
    memory_mb: float = 2000.0
    """Memory that the row needs, in megabytes."""
    fingerprint: str = ""
    """Digest of the steps and of the sizes and times of the input files. A row that is done is done for this one."""


@dataclass(frozen=True)
class State:
    """The state of a row. `status` is that of its last try."""

    name: str
    status: str
    """running, done or failed. A row that says running, but whose lock is free, was interrupted."""
    fingerprint: str
    tries: int = 1
    host: str = ""
    """Machine and process of the last try."""
    began: float = 0.0
    """Begin of the last try, in seconds since 1970."""
    seconds: float = 0.0
    """Duration of the last try."""
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds of each stage in the last try."""
    error: str = ""
    """The error in one line."""
    peak_mb: float = 0.0
    """Largest memory of the row's process, in megabytes."""
    mien: str = ""
    """Version of mien."""
    runs: tuple[dict[str, Any], ...] = ()
    """Figures of each run."""


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
        try:
            content = parse_json(read_bytes(path, _MAX_PLAN_BYTES).decode())
        except (FileNotFoundError, NotADirectoryError):
            raise UserError(
                f"{self.root}: is not the folder of a batch (no plan.json); give the one that `mien batch TABLE --out` "
                "names"
            ) from None
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: cannot be read as json ({error}); {_AGAIN}") from None
        with expect_whole(path, _AGAIN):
            if (found := (content["format"], content["version"])) != PLAN:
                raise UserError(
                    f"{path}: has format {found[0]!r:.80} version {found[1]!r:.80}, expected {PLAN[0]!r} version "
                    f"{PLAN[1]}; {_AGAIN}"
                )
            rows = [row_from(each) for each in content["rows"]]
            if len({row.name for row in rows}) < len(rows):
                raise ValueError("two rows have one name")
            return rows

    def write_plan(self, rows: Sequence[Row]) -> None:
        """Write the rows."""
        text = json.dumps({"format": PLAN[0], "version": PLAN[1], "rows": [asdict(row) for row in rows]})
        write_atomically(self.root / "plan.json", lambda aside: aside.write_text(text, encoding="utf-8"))

    def read_state(self, name: str) -> State | None:
        """The state of a row, or None if it never began. A damaged file counts as a failed try."""
        path = self.state_file(name)
        try:
            content = read_json(path, *STATE)
            with expect_whole(path, _AGAIN):
                return _state_from(content)
        except UserError as error:
            return State(name, "failed", "", error=str(error)) if path.exists() else None

    def read_states(self) -> dict[str, State]:
        """The states of all rows, by name: quickly, without their checksums. Damaged ones count as failed."""
        found = {}
        for entry in os.scandir(self.root / "states") if (self.root / "states").is_dir() else ():
            if entry.name.endswith(".json") and not entry.name.startswith("."):
                name = entry.name.removesuffix(".json")
                try:
                    # a Path takes as long to make
                    if entry.is_symlink():
                        raise ValueError("a link")
                    content = parse_json(read_bytes(entry.path, _MAX_STATE_BYTES).decode())
                    if not isinstance(content, dict) or (content["format"], content["version"]) != STATE:
                        raise ValueError("format or version")
                    content.pop("checksum", None)
                    found[name] = _state_from(content)
                except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
                    found[name] = State(name, "failed", "", error=f"{entry.path}: damaged ({error}); {_AGAIN}")
        return found

    def write_state(self, state: State) -> None:
        """Write the state of a row. The caller holds its lock."""
        write_json(self.state_file(state.name), *STATE, asdict(state))

    def remove_leftovers(self, rows: Sequence[Row]) -> None:
        """Remove the temporary files and locks that killed processes of these rows left beside the states."""
        folder = self.root / "states"
        hidden = [entry.name for entry in os.scandir(folder) if entry.name.startswith(".")] if folder.is_dir() else []
        for row in rows if hidden else ():
            path = self.state_file(row.name)
            # Names of temporary files begin like that of the state, and long ones are cut.
            if any(name.startswith(f".{path.name[:_COMPARED]}") for name in hidden):
                with suppress(BeingWrittenError), hold(path):  # the end of `hold` removes a lock
                    remove_leftovers(path)

    def is_done(self, row: Row) -> bool:
        """Whether the row is done with its present inputs."""
        state = self.read_state(row.name)
        return state is not None and state.status == "done" and state.fingerprint == row.fingerprint


def row_from(content: dict[str, Any]) -> Row:
    """A row from json.

    Raises:
        ValueError: it has no plain name, or a step is no command of words.
    """
    row = Row(**{**content, "steps": tuple(map(tuple, content["steps"])), "labels": dict(content["labels"])})
    words = [*(word for step in row.steps for word in step), *row.labels.values(), row.fingerprint]
    if not is_plain_name(row.name) or not all(isinstance(word, str) for word in words):
        raise ValueError("name, steps or labels")
    _check_numbers(row.memory_mb)
    return row


def with_fingerprint(row: Row, inputs: Sequence[Path]) -> Row:
    """The row with the digest of its steps and of the sizes and times of its input files."""
    seen = [(str(path), status.st_size, status.st_mtime_ns) for path in inputs if (status := path.stat())]
    digest = hashlib.sha256(json.dumps([row.steps, seen]).encode()).hexdigest()[:32]
    return replace(row, fingerprint=digest)


def _state_from(content: dict[str, Any]) -> State:
    for name in ("format", "version"):
        content.pop(name, None)
    state = State(**{**content, "runs": tuple(content["runs"])})
    told = (state.name, state.error, state.host, state.fingerprint, state.mien, *state.stages)
    if state.status not in _STATUSES or not all(map(is_one_line, told)):
        raise ValueError("status, name, error or host")
    for run in state.runs:
        if not all(value is None or isinstance(value, str | int | float) for value in run.values()):
            raise ValueError("runs")
        _check_numbers(*(value for value in run.values() if isinstance(value, int | float)))
        if not is_plain_name(run["run"]) or not isinstance(run["method"], str):
            raise ValueError("runs")
    _check_numbers(state.tries, state.began, state.seconds, state.peak_mb, *state.stages.values())
    return state


def _check_numbers(*numbers: Any) -> None:
    """Check that all are numbers, and of such a size that sums of them are numbers, too."""
    for number in numbers:
        if not (isinstance(number, int | float) and abs(number) < _MAX_NUMBER):
            raise ValueError("a number")
