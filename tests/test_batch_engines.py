"""The engines of clusters, each with a lost worker: Ray with two nodes on this host, and a real Slurm if one runs here.

`make batch-engines` installs what they need; without it they are skipped. Slurm: `tests/slurm_here.sh FOLDER` starts
one as root, and SLURM_CONF names it."""

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from batch_stub import drive_rows, stub_row, wait_for_begin
from mien.batch.plan import Batch
from mien.batch.progress import batch_progress
from needs import NO_ENGINE

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore")]
IN_SLURM = pytest.mark.skipif("SLURM_CONF" not in os.environ or shutil.which("sbatch") is None, reason=NO_ENGINE)
EXPECTED = {f"row{index}": 20.0 + index for index in range(4)}


@pytest.fixture
def ray_cluster() -> Iterator[Any]:
    """A cluster of two nodes on this host. Its second node is the only one in `worker_nodes`."""
    try:
        from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        pytest.skip(NO_ENGINE)
    node = {"num_cpus": 2, "object_store_memory": 80 << 20, "include_dashboard": False}
    for tries_left in (2, 1, 0):
        cluster = Cluster()
        try:
            cluster.add_node(**node)
            cluster.add_node(**node)
            break
        except Exception:  # A node waits 30 s for its agent, too short where other programs take the processor.
            cluster.shutdown()
            if not tries_left:
                raise
    yield cluster
    cluster.shutdown()


def run_with(engine: str, root: Path, rows: list, fault: object = None, **options: object) -> dict[str, Any]:
    batch = Batch(root)
    batch.write_plan(rows)
    thread = threading.Thread(target=fault, daemon=True) if callable(fault) else None
    if thread is not None:
        thread.start()
    drive_rows(batch, rows, on=engine, jobs=0, **options)
    states = [batch.read_state(row.name) for row in rows]
    return {state.name: state.runs[0]["psnr"] for state in states if state is not None and state.status == "done"}


def rows_of(seconds: str) -> list:
    return [stub_row(name, ("sleep", seconds), ("value", str(figure))) for name, figure in EXPECTED.items()]


def check_too_large(engine: str, root: Path, words: str, **options: object) -> None:
    rows = [stub_row("large", ("value", "9"), memory_mb=1e7), *rows_of("0.1")]
    assert run_with(engine, root, rows, **options) == EXPECTED
    found = {row["name"]: row for row in batch_progress(Batch(root))["rows"]}
    assert found["large"]["status"] == "failed"
    assert words in found["large"]["error"]


def begins(root: Path, name: str) -> int:
    """How often a row began. No row may run in two processes at the same time."""
    text = (root / "begins.txt").read_text()
    assert "overlap " not in text
    return text.count(f"begin {name} ")


def ancestors(process: int) -> Iterator[int]:
    """The parent of a process, its parent, and so on, as far as they live."""
    while process > 1 and (place := Path(f"/proc/{process}/stat")).exists():
        process = int(place.read_text().rpartition(")")[2].split()[1])
        yield process


def test_ray_gives_the_figures_of_an_undisturbed_run_though_a_worker_is_killed(tmp_path: Path, ray_cluster: Any):
    def kill() -> None:
        os.kill(next(ancestors(wait_for_begin(tmp_path, "row1"))), signal.SIGKILL)

    assert run_with("ray", tmp_path, rows_of("2"), kill, ray_address=ray_cluster.address) == EXPECTED
    assert begins(tmp_path, "row1") == 2


def test_ray_rows_survive_the_loss_of_their_node(tmp_path: Path, ray_cluster: Any):
    rows = [stub_row(name, ("wait", f"go {name}"), ("value", str(figure))) for name, figure in EXPECTED.items()]
    lost, until, place = [], time.monotonic() + 120, tmp_path / "begins.txt"

    def kill() -> None:
        processes = [process for _, process in list(ray_cluster.worker_nodes)[0].live_processes()]
        numbers = {process.pid for process in processes}
        while not lost and time.monotonic() < until:
            begun = [line.split() for line in place.read_text().splitlines()] if place.exists() else []
            lost.extend(name for _, name, row in begun if set(ancestors(int(row))) & numbers)
            time.sleep(0.05)
        for process in processes:
            process.kill()
            process.wait()  # workers take a node that nobody has waited for as alive
        for name in EXPECTED.keys() - lost:
            (tmp_path / f"go {name}").touch()  # their cores are free then
        while not (lost and begins(tmp_path, lost[0]) == 2) and time.monotonic() < until:
            time.sleep(0.05)
        for name in lost:
            (tmp_path / f"go {name}").touch()

    assert run_with("ray", tmp_path, rows, kill, ray_address=ray_cluster.address) == EXPECTED
    assert begins(tmp_path, lost[0]) == 2


def test_a_row_that_no_node_of_ray_can_hold_fails_alone(tmp_path: Path, ray_cluster: Any, monkeypatch: Any):
    monkeypatch.setattr("mien.batch.engines.LOOK_SECONDS", 0.5)
    monkeypatch.setattr("mien.batch.engines.PATIENCE_SECONDS", 1.0)
    check_too_large("ray", tmp_path, "enough memory", ray_address=ray_cluster.address)


@IN_SLURM
def test_slurm_gives_the_same_figures_though_a_task_is_requeued(tmp_path: Path):
    pytest.importorskip("submitit")

    def requeue() -> None:
        wait_for_begin(tmp_path / "a", "row1")
        jobs = subprocess.run(["squeue", "-h", "-r", "-o", "%i %T"], capture_output=True, text=True).stdout.split()
        running = [job for job, state in zip(jobs[::2], jobs[1::2], strict=True) if state == "RUNNING"]
        subprocess.run(["scontrol", "requeue", running[0]], check=True)
        subprocess.run(["scancel", running[-1]], check=True)

    assert run_with("slurm", tmp_path / "a", rows_of("4"), requeue) == EXPECTED
    assert begins(tmp_path / "a", "row1") > 0
    check_too_large("slurm", tmp_path / "b", "Slurm does not take it")
