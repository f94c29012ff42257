"""The engines of a batch: they start its rows here, on a Slurm cluster, or on a Ray cluster.

An engine takes the work, the rows, the batch and the options. It tries every row once and yields each with what the
work returned, or with an exception, in the order in which they end.
"""

import logging
import math
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Options, Row, Work
from mien.batch.row import stop_attempts
from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.machine.progress import say

POLL_SECONDS = 2.0
"""Seconds between two questions to Slurm."""
_NOTED = "slurm/jobs.txt"
"""The file in the batch's folder that has the numbers of Slurm's jobs which have not ended."""
LOOK_SECONDS, PATIENCE_SECONDS = 30.0, 600.0
"""How often Ray's rows are looked for that fit no node, and how long a cluster may take to start a node for them."""


def run_local(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run the rows as processes of this machine, as many at once as jobs and memory allow.

    Whatever stops this function (Ctrl-C, SIGTERM) stops the rows, too.
    """

    def one(row: Row) -> Any:
        try:
            return work(row)
        except (UserError, OSError) as error:
            return error

    with ThreadPoolExecutor(jobs_here(rows, options)) as pool:
        futures = {pool.submit(one, row): row for row in rows}
        try:
            for future in as_completed(futures):
                yield futures.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            running = [future for future in futures if not future.cancelled()]
            while wait(running, 0.5).not_done:  # a row may start after the first request to stop
                stop_attempts()


def jobs_here(rows: Sequence[Row], options: Options) -> int:
    """How many rows run at once: as asked, or one for two threads; no more than fit the memory, if all are large."""
    largest = max((row.memory_mb for row in rows), default=1.0)
    fitting = int(0.9 * free_memory_mb() / max(largest, 1.0))
    jobs = options.jobs or (os.cpu_count() or 1) // (options.threads or 2)
    return max(1, min(jobs, fitting, len(rows)))


def free_memory_mb() -> float:
    """Memory of this machine that processes can still take, in megabytes."""
    with suppress(OSError, ValueError, LookupError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith("MemAvailable:"))
        return int(kilobytes) / 1e3
    return 8000.0  # where the system does not tell it


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


def run_slurm(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run the rows as job arrays through submitit, one for each class of memory, requeued after a preemption.

    The batch's folder must be on a file system that all nodes share. Which rows are done is read from their states, so
    no accounting of Slurm is needed. Jobs go on if this process ends; the same command waits for them before it submits
    more.
    """
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
        time=(options.time or _minutes(batch)) * size,
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


def run_ray(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run each row as a task of a Ray cluster, or of a Ray that is started here for the time of the batch.

    Ray starts a row again if its node is lost. The batch's folder must be shared by all nodes, unless a store is given.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

    address = options.ray_address or os.environ.get("RAY_ADDRESS")
    started: dict[str, Any] = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING, **started)
    except Exception as error:  # Ray has no class of its own for this
        why = " ".join(str(error).split())[:300]
        raise UserError(f"Ray cannot be reached or started ({why}); see `ray status`, and --ray-address") from None
    task: Any = ray.remote(lambda work, row: work(row))  # pyright: ignore[reportCallIssue]
    told = (
        f"no node of Ray has had enough memory, cores or GPUs for it for {PATIENCE_SECONDS / 60:.0f} min; "
        "see `ray status`, memory_gb, --threads and --gpus"
    )
    running: dict[Any, Row] = {}
    unfitting: dict[Any, float] = {}
    waiting = list(reversed(rows))
    try:
        while waiting or running:
            while waiting and len(running) < (options.jobs or 200):
                row = waiting.pop()
                asked = {
                    "num_cpus": options.threads or 2,
                    "num_gpus": options.gpus,
                    "memory": round(row.memory_mb * 1e6),
                }
                asked |= {"max_retries": 3, "name": f"mien {row.name}"}
                running[task.options(**asked).remote(work, row)] = row
            ended, _ = ray.wait(list(running), num_returns=1, timeout=LOOK_SECONDS)
            for first in ended:
                row = running.pop(first)
                try:
                    yield row, ray.get(first)
                except (RayError, UserError, OSError) as error:
                    yield row, error
            if not ended:
                for late in _never_started(ray, running, unfitting, options):
                    ray.cancel(late)
                    yield running.pop(late), UserError(told)
    finally:
        ray.shutdown()


def _never_started(ray: Any, running: dict[Any, Row], since: dict[Any, float], options: Options) -> list[Any]:
    """The tasks that no node of the cluster has been large enough for, for so long that no new one will come.

    Ray would wait for such a node for ever.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    now, found = time.monotonic(), []
    for task, row in running.items():
        asked = {"CPU": options.threads or 2, "GPU": options.gpus, "memory": round(row.memory_mb * 1e6)}
        if any(all(node.get(kind, 0) >= amount for kind, amount in asked.items()) for node in nodes):
            since.pop(task, None)
        elif now - since.setdefault(task, now) >= PATIENCE_SECONDS:
            found.append(task)
    return found


ENGINES: dict[str, Callable[[Work, Sequence[Row], Batch, Options], Iterator[tuple[Row, Any]]]] = {
    "local": run_local,
    "slurm": run_slurm,
    "ray": run_ray,
}
