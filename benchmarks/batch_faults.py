"""Real rows of a batch with faults.

    PYTHONPATH=tests python benchmarks/batch_faults.py ENGINE TABLE FOLDER [--address RAY] [--node PID]

Faults come while rows track and train: SIGKILL of a row, of a worker of the engine, of a node and of the driver, and
what the engine itself offers (`scontrol requeue`, `scancel`). Then the same command runs to its end. The script prints
what it did, whether a row ran twice at the same time, and what was left over. Compare results.csv with those of an
undisturbed run.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from batch_stub import note, watched
from mien.batch.plan import Batch, Row
from mien.batch.progress import batch_progress, progress_text
from mien.batch.row import do_steps, row_process
from mien.cli import main as mien
from mien.disk.files import read_json

Fault = tuple[str, str, str, Callable[[int], object]]
"""A row, words of its log, what is done then, and how, given the row's process."""


def real_row(root: Path) -> int:
    """Be the process of a real row, with a lock that tells whether the row runs twice at the same time."""

    def do(batch: Batch, row: Row) -> Any:
        with watched(root / "begins.txt", row.name):
            start = batch.log_file(row.name).stat().st_size
            note(root / "begins.txt", f"begin {row.name} {os.getpid()} {start}\n")
            return do_steps(mien, batch, row)

    return row_process(root, sys.stdin, do)


def ancestors(process: int) -> Iterator[int]:
    """The parent of a process, its parent, and so on."""
    while process > 1 and (place := Path(f"/proc/{process}/stat")).exists():
        process = int(place.read_text().rpartition(")")[2].split()[1])
        yield process


def wait_until(root: Path, name: str, words: str) -> int:
    """Wait until the log of a row has words of its present process, and return that."""
    while True:
        place = root / "begins.txt"
        lines = [line.split() for line in place.read_text().splitlines()] if place.exists() else []
        mine = [(int(line[2]), int(line[3])) for line in lines if line[:2] == ["begin", name]]
        said = (root / "logs" / f"{name}.log").read_bytes()[mine[-1][1] :] if mine else b""
        if words.encode() in said and Path(f"/proc/{mine[-1][0]}").exists():
            return mine[-1][0]
        time.sleep(0.2)


def kill(process: int) -> None:
    """End a process by SIGKILL."""
    os.kill(process, signal.SIGKILL)


def slurm_task(row: int) -> str:
    """The task of Slurm that runs a row: the number that Slurm gave to its process."""
    words = Path(f"/proc/{row}/environ").read_bytes().decode().split("\0")
    told = {name: value for name, _, value in (word.partition("=") for word in words)}
    return f"{told['SLURM_ARRAY_JOB_ID']}_{told['SLURM_ARRAY_TASK_ID']}"


def faults_of(engine: str, first: str, second: str, driver: Callable[[], int], node: int) -> list[Fault]:
    """The faults of an engine, in their order."""
    stop_driver = (second, "stage 3 of", "kill -9 of the driver", lambda row: kill(driver()))
    if engine == "local":
        return [(first, "stage 3 of", "kill -9 of the row", kill), stop_driver]
    if engine == "slurm":
        return [
            (first, "stage 2 of", "scontrol requeue", lambda row: run("scontrol", "requeue", slurm_task(row))),
            stop_driver,
            (second, "stage 4 of", "scancel", lambda row: run("scancel", slurm_task(row))),
            (first, "stage 3 of", "kill -9 of the row", kill),
        ]
    return [
        (first, "stage 2 of", "kill -9 of the worker", lambda row: kill(next(ancestors(row)))),
        (first, "stage 3 of", "kill -9 of the row", kill),
        (second, "stage 3 of", "kill -9 of the node", lambda row: kill(node)),
        (second, "stage 3 of", "kill -9 of the driver", lambda row: kill(driver())),
    ]


def run(*command: str) -> None:
    """Run a command."""
    subprocess.run(command, check=True)


def tell(root: Path) -> None:
    """Print how the rows are, and what lies about that is neither whole nor ours."""
    print(progress_text(batch_progress(Batch(root))))
    begins = (root / "begins.txt").read_text()
    print(f"begins: {begins.count('begin ')}, twice at once: {begins.count('overlap ')}")
    hidden = [str(path.relative_to(root)) for path in root.rglob(".*") if path.is_file()]
    print(f"hidden files: {hidden}")
    for path in (root / "states").glob("*.json"):
        read_json(path, "mien.batch-row", 1)


def main() -> None:
    """Run the trial."""
    parser = argparse.ArgumentParser()
    for name in ("engine", "table", "folder"):
        parser.add_argument(name)
    parser.add_argument("--address", default="")
    parser.add_argument("--node", type=int, default=0)
    given, extra = parser.parse_known_args()
    root = Path(given.folder).resolve()
    root.mkdir(parents=True)
    program = f"{sys.executable} {Path(__file__).resolve()} --row"
    code = "import sys; from mien.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "batch", given.table, "--out", str(root), "--on", given.engine]
    command += ["--program", program, *(["--ray-address", given.address] if given.address else []), *extra]
    drivers = [subprocess.Popen(command)]
    names = [line.split(",")[0] for line in Path(given.table).read_text().splitlines()[1:]]
    first, second = names[:2]
    for name, words, what, make in faults_of(given.engine, first, second, lambda: drivers[-1].pid, given.node):
        make(wait_until(root, name, words))
        print(f"{name}, {words.strip(': ')}: {what}", flush=True)
        if "driver" in what:
            drivers[-1].wait()
            drivers.append(subprocess.Popen(command))
    code = drivers[-1].wait() or subprocess.call(command)
    print("exit code", code)
    tell(root)


if __name__ == "__main__":
    sys.exit(real_row(Path(sys.argv[-1])) if "--row" in sys.argv else main())
