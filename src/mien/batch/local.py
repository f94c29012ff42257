"""The engine `local`: processes on this machine that share its threads and its memory."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Options, Row, Work
from mien.batch.row import stop_attempts
from mien.errors import UserError


def run(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run the rows here, as many at once as jobs and memory allow (`mien.batch.drive` says what an engine does).

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
