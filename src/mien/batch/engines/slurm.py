"""The engine `slurm`: job arrays through submitit, with a cap on parallel jobs, requeued after a preemption.

The batch's folder must be on a file system that all nodes share. Which rows are done is read from their states, so no
accounting of Slurm is needed. Jobs go on if this process ends; the same command waits for them before it submits more.
"""

import math
import subprocess
import time
from collections.abc import Iterator, Sequence
from typing import Any

from mien.batch.engines import EngineOptions, Work
from mien.batch.plan import Batch, Row
from mien.errors import UserError
from mien.files import write_atomically

_MOST_TASKS = 1000
"""Largest number of tasks of an array. Slurm's default limit is 1001."""
_POLL_SECONDS = 2.0
_DEFAULT_MINUTES, _SLACK, _LEAST_MINUTES = 24 * 60, 3.0, 10


class _Task:
    """The work of a task of the array. Submitit calls `checkpoint` before a preemption, and requeues its result."""

    def __init__(self, work: Work) -> None:
        self.work = work

    def __call__(self, rows: Sequence[Row]) -> None:
        for row in rows:
            self.work(row)

    def checkpoint(self, rows: Sequence[Row]) -> Any:
        import submitit  # pyright: ignore[reportMissingImports]

        return submitit.helpers.DelayedSubmission(self, rows)


def run(work: Work, rows: Sequence[Row], options: EngineOptions) -> Iterator[tuple[Row, Any]]:
    """Run the rows as a job array. See `mien.batch.engines`."""
    import submitit  # pyright: ignore[reportMissingImports]

    batch, folder = Batch(options.root), options.root / "slurm"
    noted = folder / "jobs.txt"
    left = list(rows)
    if noted.is_file():  # an earlier driver has submitted them
        _wait(noted.read_text(encoding="utf-8").strip())
        left = [row for row in rows if not batch.is_done(row)]
    if left:
        folder.mkdir(parents=True, exist_ok=True)
        size = math.ceil(len(left) / _MOST_TASKS)
        tasks = [left[start : start + size] for start in range(0, len(left), size)]
        executor = submitit.SlurmExecutor(folder, max_num_timeout=10)
        executor.update_parameters(**_parameters(batch, left, options, size))
        jobs = executor.map_array(_Task(work), tasks)
        number = str(jobs[0].job_id).partition("_")[0]
        write_atomically(noted, lambda aside: aside.write_text(number, encoding="utf-8"))
        _wait(number)
    noted.unlink(missing_ok=True)
    for row in rows:
        yield row, batch.read_state(row.name)


def _parameters(batch: Batch, rows: Sequence[Row], options: EngineOptions, size: int) -> dict[str, Any]:
    """The resources of each task of the array, as Slurm is asked for them."""
    finished = [state.seconds for row in batch.read_plan() if (state := batch.read_state(row.name)) and state.runs]
    minutes = max(_LEAST_MINUTES, math.ceil(_SLACK * max(finished) / 60)) if finished else _DEFAULT_MINUTES
    found: dict[str, Any] = {
        "job_name": "mien-batch",
        "time": (options.minutes or minutes) * size,
        "mem": f"{math.ceil(max(row.memory_mb for row in rows))}M",
        "cpus_per_task": options.threads or 2,
        "array_parallelism": options.jobs or 256,
        "stderr_to_stdout": True,
        "additional_parameters": {"requeue": True},
    }
    if options.partition:
        found["partition"] = options.partition
    if options.gpus:
        found["gpus_per_task"] = math.ceil(options.gpus)
    return found


def _wait(number: str) -> None:
    """Wait until a job has left the queue."""
    while number.isdigit():
        asked = subprocess.run(["squeue", "-h", "-j", number], capture_output=True, text=True)
        if asked.returncode and "Invalid job id" not in asked.stderr:
            raise UserError(f"squeue: {asked.stderr.strip()[:300]}; correct that and run the same command again")
        if not asked.stdout.strip():
            return
        time.sleep(_POLL_SECONDS)
