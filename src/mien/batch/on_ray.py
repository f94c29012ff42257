"""The engine `ray`: tasks on a Ray cluster, or on a Ray that is started here for the time of the batch.

Ray starts a row again if its node is lost. The batch's folder must be shared by all nodes, unless a store is given.
"""

import logging
import os
import time
from collections.abc import Iterator, Sequence
from typing import Any

from mien.batch.plan import Batch, Options, Row, Work
from mien.errors import UserError

LOOK_SECONDS, PATIENCE_SECONDS = 30.0, 600.0
"""How often rows are looked for that fit no node, and how long a cluster may take to start a node for them."""
_NO_NODE = (
    f"no node of Ray has had enough memory, cores or GPUs for it for {PATIENCE_SECONDS / 60:.0f} min; "
    "see `ray status`, memory_gb, --threads and --gpus"
)


def run(work: Work, rows: Sequence[Row], batch: Batch, options: Options) -> Iterator[tuple[Row, Any]]:
    """Run each row as a task (`mien.batch.drive` says what an engine does)."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray  # pyright: ignore[reportMissingImports]
    from ray.exceptions import RayError  # pyright: ignore[reportMissingImports]

    address = options.address or os.environ.get("RAY_ADDRESS")
    started: dict[str, Any] = {} if address else {"include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING, **started)
    except Exception as error:  # Ray has no class of its own for this
        why = " ".join(str(error).split())[:300]
        raise UserError(f"Ray cannot be reached or started ({why}); see `ray status`, and --ray-address") from None
    task: Any = ray.remote(lambda work, row: work(row))  # pyright: ignore[reportCallIssue]
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
                    yield running.pop(late), UserError(_NO_NODE)
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
