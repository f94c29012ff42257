"""The engine `slurm`: job arrays through submitit, with a cap on parallel jobs, requeued after a preemption.

The batch's folder must be on a file system that all nodes share. Which rows are done is read from their states, so no
accounting of Slurm is needed. Jobs go on if this process ends; the same command waits for them before it submits more.
"""

import math
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Options, Row, Work
from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.machine.progress import say

POLL_SECONDS = 2.0
"""Seconds between two questions to Slurm."""
_NOTED = "slurm/jobs.txt"
"""The file in the batch's folder that has the numbers of jobs which have not ended."""


class _Task:
    """The work of a task of the array. Submitit calls `checkpoint` before a preemption, and requeues its result."""

    def __init__(self, work: Work) -> None:
        self.work = work

    def __call__(self, rows: Sequence[Row]) -> None:
        for row in rows:
            with suppress(UserError, OSError):  # such as a full disk: the next row may fit
                self.work(row)

    def checkpoint(self, rows: Sequence[Row]) -> Any:
        import submitit  # pyright: ignore[reportMissingImports]

        return submitit.helpers.DelayedSubmission(self, rows)


def run(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run the rows as job arrays, one for each class of memory (`mien.batch.drive` says what an engine does)."""
    noted = batch.root / _NOTED
    numbers, taken = list[str](), list[Row]()
    size = math.ceil(len(rows) / 1000)  # an array has at most 1001 tasks by default
    for alike in _by_memory(rows):
        try:
            numbers.append(_submit(work, alike, batch, options, size))
        except UserError as error:
            yield from ((row, error) for row in alike)
        else:
            taken += alike
            write_atomically(noted, lambda aside: aside.write_text(",".join(numbers), encoding="utf-8"))
    _wait(noted)
    yield from ((row, batch.read_state(row.name)) for row in taken)


def wait_for_earlier(batch: Batch) -> None:
    """Wait for the jobs of a driver that has ended before them. Their rows run, so no other driver could take them."""
    if (batch.root / _NOTED).is_file():
        say("waiting for the rows that an earlier command has given to Slurm")
        _wait(batch.root / _NOTED)


def _by_memory(rows: Sequence[Row]) -> list[list[Row]]:
    """The rows whose memory lies between the same powers of two.

    An array asks for the memory of its largest row: one would keep all others from small nodes, or from being taken.
    """
    found: dict[int, list[Row]] = {}
    for row in rows:
        found.setdefault(math.ceil(math.log2(max(row.memory_mb, 1.0))), []).append(row)
    return [found[each] for each in sorted(found)]


def _submit(work: Work, rows: Sequence[Row], batch: Batch, options: Options, size: int) -> str:
    """Submit an array with `size` rows in each task, and return its number."""
    import submitit  # pyright: ignore[reportMissingImports]
    from submitit.core.utils import FailedJobError, FailedSubmissionError  # pyright: ignore[reportMissingImports]

    folder = batch.place("slurm")
    folder.mkdir(parents=True, exist_ok=True)
    executor = submitit.SlurmExecutor(folder, max_num_timeout=10)
    executor.update_parameters(
        job_name="mien-batch",
        time=(options.minutes or _minutes(batch)) * size,
        mem=f"{math.ceil(max(row.memory_mb for row in rows))}M",
        cpus_per_task=options.threads or 2,
        gpus_per_task=math.ceil(options.gpus) or None,
        partition=options.partition or None,
        array_parallelism=options.jobs or 256,
        stderr_to_stdout=True,
        additional_parameters={"requeue": True},
    )
    try:
        jobs = executor.map_array(_Task(work), [rows[start : start + size] for start in range(0, len(rows), size)])
    except (FailedJobError, FailedSubmissionError) as error:
        why = " ".join(str(error).split())
        raise UserError(f"Slurm does not take it ({why[-300:]}); see `sinfo -N -o '%N %c %m'`, and memory_gb") from None
    return str(jobs[0].job_id).partition("_")[0]


def _minutes(batch: Batch) -> int:
    """The time limit of a row: three times the longest finished row, at first a day."""
    longest = max((state.seconds for state in batch.read_states().values() if state.runs), default=0.0)
    return max(10, math.ceil(3.0 * longest / 60)) if longest else 24 * 60


def _wait(noted: Path) -> None:
    """Wait until the jobs of a note have left the queue, and remove the note."""
    numbers = noted.read_text(encoding="utf-8").strip() if noted.is_file() else ""
    while numbers.replace(",", "").isdecimal():
        asked = subprocess.run(["squeue", "-h", "-j", numbers], capture_output=True, text=True)
        if asked.returncode and "Invalid job id" not in asked.stderr:
            raise UserError(f"squeue: {asked.stderr.strip()[:300]}; correct that and run the same command again")
        if not asked.stdout.strip():
            break
        time.sleep(POLL_SECONDS)
    noted.unlink(missing_ok=True)
