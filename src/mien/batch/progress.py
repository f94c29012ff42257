"""How far a batch is: its rows, totals, throughput and the expected end, for people and for programs."""

import re
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Row, State
from mien.batch.row import repeat_command, tail
from mien.batch.store import is_url
from mien.disk.locks import holder_of
from mien.machine.terminal import counted, printable

_STAGE = re.compile(r"stage (\d+) of (\d+) \(([\w -]+)\)")
_PART = re.compile(r": (\d+)/(\d+) in ")
_SHOWN = 40
"""Number of rows of each kind that the text lists."""


def batch_progress(batch: Batch) -> dict[str, Any]:
    """The state of all rows, and totals, in a form for json."""
    states = batch.read_states()
    rows = [_row(batch, row, states.get(row.name)) for row in batch.read_plan()]
    counts = Counter(row["status"] for row in rows)
    done = [row for row in rows if row["status"] == "done"]
    left = len(rows) - len(done) - counts["failed"]
    found: dict[str, Any] = {"format": "mien.batch-status", "version": 1, "rows": rows, "counts": dict(counts)}
    found |= {"rows_per_hour": None, "seconds_left": None}
    if done:
        began = min(row["began"] for row in done)
        span = max(max(row["began"] + row["seconds"] for row in done) - began, 1e-3)
        found["rows_per_hour"] = round(len(done) / span * 3600, 2)
        mean = sum(row["seconds"] for row in done) / len(done)
        found["seconds_left"] = round(left * mean / max(counts["running"], 1)) if counts["running"] else None
    return found


def running_words(batch: Batch, rows: Sequence[Row]) -> str:
    """Return what runs now, in one line: the stage of each of the first running rows, and its percentage.

    Only the first 100 rows are looked at, because each costs a read.
    """
    found = (_row(batch, row, batch.read_state(row.name)) for row in rows[:100])
    running = [row for row in found if row["status"] == "running"]
    words = [f"{row['name']}: {row['stage'] or 'running'}{_percent(row)}" for row in running[:4]]
    return printable("; ".join(words + ["..."] * (len(running) > 4)))


def _row(batch: Batch, row: Row, state: State | None) -> dict[str, Any]:
    # The state of a damaged file has no fingerprint. It is shown, because someone has to know.
    if state is None or (state.fingerprint not in ("", row.fingerprint) and state.status != "running"):
        return {"name": row.name, "status": "waiting"}
    found = {"name": row.name, "status": state.status, "tries": state.tries, "host": state.host}
    found |= {"began": state.began, "seconds": state.seconds}
    if state.status == "failed":
        found["error"] = state.error
        if not any(is_url(word) for step in row.steps for word in step):  # which only a row fetches
            found["repeat"] = repeat_command(batch, row)
    if state.status == "running":
        if holder_of(batch.state_file(row.name)) is None:
            found["status"] = "interrupted"
        else:
            found |= {"seconds": round(time.time() - state.began), **_stage(batch, state)}
    return found


@dataclass(frozen=True)
class Stage:
    """The stage that a command is in."""

    name: str
    """Empty if the command has not said so."""
    number: int
    of: int
    percent: int | None
    """How far its present part is; None if that is not known."""


def stage_of(log: Path, since: int = 0) -> Stage:
    """The stage that the command which writes a log is in, by what follows its first `since` bytes."""
    found, percent, text = ("", 0, 0), None, ""
    for most in (1 << 13, 1 << 17, 1 << 22):  # hours of lines may follow that of a stage
        if not _STAGE.search(text):
            text = tail(log, since, most)
    for line in text.replace("\r", "\n").splitlines():
        if named := _STAGE.search(line):
            now = (named[3], int(named[1]), int(named[2]))
            found, percent = now, percent if now == found else None
        elif part := _PART.search(line):
            percent = round(100 * int(part[1]) / max(int(part[2]), 1))
    return Stage(*found, percent)


def _stage(batch: Batch, state: State) -> dict[str, Any]:
    found = stage_of(batch.log_file(state.name))
    words = f"{found.name} ({found.number} of {found.of})" if found.name else None
    return {"stage": words, "percent": found.percent}


def progress_text(found: dict[str, Any]) -> str:
    """The same for people."""
    lines = []
    for status in ("running", "interrupted", "failed"):
        rows = [row for row in found["rows"] if row["status"] == status]
        for row in rows[:_SHOWN]:
            lines.append(f"{row['name']}: {_words(row)}")
            if "repeat" in row:
                lines.append(f"    repeat it: {row['repeat']}")
        if len(rows) > _SHOWN:
            lines.append(f"... and {len(rows) - _SHOWN} more {status}; --json lists all")
    counts, total = found["counts"], len(found["rows"])
    lines.append(f"{counted(total, 'row')}: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
    if found["rows_per_hour"] is not None:
        left = found["seconds_left"]
        eta = f", about {left / 60:.0f} min left" if left else ""
        lines.append(f"{found['rows_per_hour']:g} rows an hour{eta}")
    return printable("\n".join(lines), lines=True)


def _words(row: dict[str, Any]) -> str:
    seconds = f", {row['seconds']:.0f} s" if row["seconds"] else ""  # nobody wrote how long an interrupted row took
    host = f" on {row['host']}" if row["host"] else ""  # nobody can read it from a damaged file
    where = f"{row['status']}{host}{seconds}, try {row['tries']}"
    stage = f", {row['stage']}" if row.get("stage") else ""
    return f"{where}{stage}{_percent(row)}" + (f": {row['error']}" if row.get("error") else "")


def _percent(row: dict[str, Any]) -> str:
    return "" if row.get("percent") is None else f", {row['percent']} %"
