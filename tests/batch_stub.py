"""The process of a row for trials of engines: it appends to a list of begins, waits, and fails where it is told to.

A lock of its own, apart from mien's, tells whether a row runs twice at the same time: the list then has `overlap NAME`.

Its steps are words: `sleep SECONDS`, `wait NAME` (until the batch's folder has that file), `fail TEXT`, `once TEXT`
(fail in the first try), `eat MEGABYTES`, `value NUMBER`, `make NAME` (a file in the workspace, and `drop NAME` removes
it), `size PATH` (of a file, as the value). Commands of mien do nothing."""

import fcntl
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mien.batch.drive import drive
from mien.batch.plan import Batch, Options, Row
from mien.batch.row import RowFailedError, row_process
from mien.batch.store import fetched
from mien.machine.stops import orderly_stops

PROGRAM = (sys.executable, str(Path(__file__).resolve()))


def stub_row(name: str, *steps: tuple[str, str], memory_mb: float = 100.0) -> Row:
    return Row(name, steps, {"kind": "stub"}, memory_mb, fingerprint=str(hash(steps) & 0xFFFF))


def do_stub(batch: Batch, row: Row) -> tuple[tuple[dict[str, object], ...], dict[str, float]]:
    """Run the stub steps. Begins and ends are appended to one file, so that overlaps and losses show."""
    place = batch.root / "begins.txt"
    with watched(place, row.name):
        return do_steps(batch, place, row)


def do_steps(batch: Batch, place: Path, row: Row) -> tuple[tuple[dict[str, object], ...], dict[str, float]]:
    note(place, f"begin {row.name} {os.getpid()}\n")
    value = 0.0
    for what, argument, *_ in row.steps:
        if what == "sleep":
            time.sleep(float(argument))
        elif what == "wait":
            while not (batch.root / argument).exists():
                time.sleep(0.05)
        elif what == "fail" or (what == "once" and tries(place, row.name) == 1):
            raise RowFailedError(argument)
        elif what == "eat":
            _ = bytearray(int(argument) << 20)
        elif what == "value":
            value = float(argument)
        elif what == "size":
            value = float(Path(fetched(argument, batch.root / "inputs")).stat().st_size)
        elif what in ("make", "drop"):
            path = batch.workspace(row.name) / argument
            path.parent.mkdir(parents=True, exist_ok=True)
            note(path, f"{row.name}\n") if what == "make" else path.unlink()
    note(place, f"end {row.name} {os.getpid()}\n")
    return ({"run": "stub", "method": "stub", "psnr": value},), {"sleep": 0.0}


@contextmanager
def watched(place: Path, name: str) -> Iterator[None]:
    """Hold a lock on the row, and note it if another process or thread holds it."""
    folder = place.parent / "watch"
    folder.mkdir(exist_ok=True)
    with (folder / name).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            note(place, f"overlap {name} {os.getpid()}\n")
        yield


def note(path: Path, line: str) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.write(handle, line.encode())
    os.close(handle)


def tries(path: Path, name: str) -> int:
    return path.read_text().count(f"begin {name} ") if path.exists() else 0


def drive_rows(batch: Batch, rows: Sequence[Row], **options: Any) -> None:
    drive(batch, rows, Options(**{"jobs": 2, "threads": 1, "retry": 1, "program": shlex.join(PROGRAM), **options}))


def drive_stubs(root: str) -> None:
    """Run the rows of a plan, as a command does."""
    batch = Batch(Path(root))
    with orderly_stops():
        drive_rows(batch, batch.read_plan())


def wait_for_begin(root: Path, name: str) -> int:
    """Return the process that began a row, once it has."""
    place = root / "begins.txt"
    for _ in range(6_000):
        for line in place.read_text().splitlines() if place.exists() else ():
            if line.startswith(f"begin {name} "):
                return int(line.split()[2])
        time.sleep(0.05)
    raise AssertionError(f"{name} never began")


def ended(process: int) -> bool:
    for _ in range(6_000):
        if not Path(f"/proc/{process}").exists():
            return True
        time.sleep(0.02)
    return False


if __name__ == "__main__":
    if "eat" in sys.argv:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
    sys.exit(row_process(Path(sys.argv[-1]), sys.stdin, do_stub))
