"""The engines of clusters, each with a lost worker: Ray with two nodes on this host, and a real Slurm if one runs here.

`make batch-engines` installs what they need; without it they are skipped. Slurm: `tests/slurm_here.sh FOLDER` starts
one as root, and SLURM_CONF names it.
"""

import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from batch_stub import PROGRAM, stub_row
from mien.batch import Batch, Driver, EngineOptions, batch_progress
from needs import NO_ENGINE
from test_batch import wait_for_begin


@pytest.fixture
def ray_address() -> Iterator[str | None]:
    """A cluster of two nodes on this host; the second is the last of the processes."""
    try:
        from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        pytest.skip(NO_ENGINE)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "object_store_memory": 80 << 20})
    cluster.add_node(num_cpus=2, object_store_memory=80 << 20)
    yield cluster.address
    cluster.shutdown()


def run_with(engine: str, root: Path, rows: list, fault: object = None, **options: object) -> dict[str, float]:
    """Run rows by an engine, with a fault meanwhile, and return the figure of each done row."""
    batch = Batch(root)
    batch.write_plan(rows)
    thread = threading.Thread(target=fault, daemon=True) if callable(fault) else None
    if thread is not None:
        thread.start()
    Driver(batch, engine, EngineOptions(root, 0, 1, **options), 1, "", PROGRAM).run(rows)  # type: ignore[arg-type]
    assert {row["status"] for row in batch_progress(batch)["rows"]} == {"done"}
    states = [batch.read_state(row.name) for row in rows]
    return {state.name: state.runs[0]["psnr"] for state in states if state is not None}


def rows_of(count: int, seconds: str) -> list:
    return [stub_row(f"row{index}", ("sleep", seconds), ("value", str(20 + index))) for index in range(count)]


def overlaps(root: Path) -> int:
    """How often a row began a second time while its first process was not over."""
    open_rows: dict[str, str] = {}
    found = 0
    for line in (root / "begins.txt").read_text().splitlines():
        what, name, pid = line.split()
        if what == "end":
            open_rows.pop(name, None)
        else:
            before = open_rows.get(name)
            found += before is not None and Path(f"/proc/{before}").exists()
            open_rows[name] = pid
    return found


EXPECTED = {f"row{index}": 20.0 + index for index in range(4)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ray_gives_the_figures_of_an_undisturbed_run_though_a_worker_is_killed(tmp_path: Path, ray_address: str | None):
    def kill() -> None:
        row = wait_for_begin(tmp_path, "row1")
        parent = int(Path(f"/proc/{row}/stat").read_text().rpartition(")")[2].split()[1])
        os.kill(parent, signal.SIGKILL)

    assert run_with("ray", tmp_path, rows_of(4, "2"), kill, address=ray_address) == EXPECTED
    assert overlaps(tmp_path) == 0
    assert (tmp_path / "begins.txt").read_text().count("begin row1 ") == 2


@pytest.mark.slow
@pytest.mark.skipif("SLURM_CONF" not in os.environ or shutil.which("sbatch") is None, reason=NO_ENGINE)
def test_slurm_gives_the_same_figures_though_a_task_is_requeued(tmp_path: Path):
    pytest.importorskip("submitit")

    def requeue() -> None:
        wait_for_begin(tmp_path, "row1")
        jobs = subprocess.run(["squeue", "-h", "-r", "-o", "%i %T"], capture_output=True, text=True).stdout.split()
        running = [job for job, state in zip(jobs[::2], jobs[1::2], strict=True) if state == "RUNNING"]
        subprocess.run(["scontrol", "requeue", running[0]], check=True)
        subprocess.run(["scancel", running[-1]], check=True)

    assert run_with("slurm", tmp_path, rows_of(4, "4"), requeue) == EXPECTED
    assert overlaps(tmp_path) == 0
