"""The engine `ray`: tasks on a Ray cluster, or on a Ray that is started here for the time of the batch.

Ray starts a row again if its node is lost. The batch's folder must be shared by all nodes, unless a store is given.
"""

import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

from mien.batch.engines import EngineOptions, Work
from mien.batch.plan import Row
from mien.errors import UserError

_LOST_NODES = 3
"""How often Ray starts a row again whose node or worker was lost."""
_WAITING = 200
"""Rows that are handed to Ray at a time, if no number of jobs is given."""


def run(work: Work, rows: Sequence[Row], options: EngineOptions) -> Iterator[tuple[Row, Any]]:
    """Run each row as a task. See `mien.batch.engines`."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

    address = options.address or os.environ.get("RAY_ADDRESS")
    started = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING, **started)
    except Exception as error:  # Ray has no class of its own for this
        why = " ".join(str(error).split())[:300]
        raise UserError(f"Ray cannot be reached or started ({why}); see `ray status`, and --ray-address") from None
    task = ray.remote(_call)
    running: dict[Any, Row] = {}
    waiting = list(reversed(rows))
    try:
        while waiting or running:
            while waiting and len(running) < (options.jobs or _WAITING):
                row = waiting.pop()
                asked = task.options(
                    num_cpus=options.threads or 2,
                    num_gpus=options.gpus,
                    memory=round(row.memory_mb * 1e6),
                    max_retries=_LOST_NODES,
                    name=f"mien {row.name}",
                )
                running[asked.remote(work, row)] = row
            (first, *_), _ = ray.wait(list(running), num_returns=1)
            row = running.pop(first)
            try:
                yield row, ray.get(first)
            except (RayError, OSError) as error:
                yield row, error
    finally:
        ray.shutdown()


def _call(work: Work, row: Row) -> Any:
    """Do the work of a row on a node."""
    return work(row)
