"""A trial of an engine with many stub rows, which sleep.

    PYTHONPATH=tests python benchmarks/batch_trial.py ENGINE FOLDER [--kills 20]

It prints seconds, the driver's memory, the time of `mien batch status`, rows that began or
ended more than once, rows that ran twice at the same time, and rows that were lost. With `--kills`, processes are
killed at random while it runs: the driver, workers, and tasks or nodes of the engine. Stub rows run in the process that
the engine starts (the driver's own on `local`), since 10,000 starts of Python would take hours.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import mien.batch.drive
from batch_stub import do_stub, stub_row
from mien.batch.plan import Batch, Options, Row, State
from mien.batch.results import write_results
from mien.batch.row import run_row

_JOBS = int(os.environ.get("MIEN_TRIAL_JOBS", "64"))
_BYTES_A_ROW = 40
"""Bytes that the begin and the end of a row take in their list."""


def rows_of(count: int, seconds: float) -> list[Row]:
    """Rows that sleep for a while: one in 100 ten times as long, and one in 30 fails in its first try."""
    draw = random.Random(41)
    rows = []
    for index in range(count):
        length = seconds * draw.uniform(0.5, 1.5) * (10 if index % 100 == 0 else 1)
        steps = [("once", "a hiccup")] if draw.random() < 1 / 30 else []
        steps += [("sleep", f"{length:.2f}"), ("value", str(index))]
        rows.append(stub_row(f"row{index:05d}", *steps, memory_mb=20.0))
    return rows


def work(root: str, row: Row) -> State | None:
    """Run a stub row in this process."""
    return run_row(Batch(Path(root)), row, do_stub)


def drive(engine: Literal["local", "slurm", "ray"], root: Path, address: str) -> None:
    """Be the driver."""
    batch = Batch(root)
    options = Options(on=engine, jobs=_JOBS, threads=1, ray_address=address)
    mien.batch.drive.drive(batch, batch.read_plan(), options, partial(work, str(root.resolve())))


def children_named(word: str, root: Path) -> list[int]:
    """Processes of this machine whose command line has a word, and whose environment has this trial's mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal() or int(entry.name) == os.getpid():
            continue
        try:
            mark = f"MIEN_TRIAL={root}".encode() in (entry / "environ").read_bytes().split(b"\0")
            if mark and word.encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def kill_one(what: str, word: str, root: Path) -> str | None:
    """Kill a random process of the trial whose command line has a word by SIGKILL, and say what it was."""
    found = children_named(word, root)
    if not found:
        return None
    os.kill(random.choice(found), signal.SIGKILL)
    return f"kill -9 of {what}"


def slurm_command(*command: str) -> str | None:
    """Run a command of Slurm on a random running task."""
    asked = subprocess.run(["squeue", "-h", "-r", "-t", "R", "-o", "%i"], capture_output=True, text=True)
    tasks = asked.stdout.split()
    if not tasks:
        return None
    done = subprocess.run([*command, random.choice(tasks)], capture_output=True)
    return " ".join(command) if done.returncode == 0 else None


def ray_node(cluster: Any) -> str | None:
    """Kill all processes of a second node of Ray, and start another one."""
    for _, process in cluster["node"].live_processes():
        process.kill()
        process.wait()  # workers take a node that nobody has waited for as alive
    for _ in range(5):
        with suppress(Exception):  # Ray has no class of its own for a node that a busy machine has not started in time
            cluster["node"] = cluster["cluster"].add_node(num_cpus=_JOBS // 2, object_store_memory=80 << 20)
            break
    return "kill -9 of a node"


def main() -> None:
    """Run the trial."""
    parser = argparse.ArgumentParser()
    parser.add_argument("engine")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--drive", action="store_true")
    parser.add_argument("--address", default="")
    given = parser.parse_args()
    root = given.folder.resolve()
    if given.drive:
        drive(given.engine, root, given.address)
        return
    os.environ["MIEN_TRIAL"] = str(root)
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1] / "tests")
    batch = Batch(root)
    batch.write_plan(rows_of(given.rows, given.seconds))
    cluster, faults = start(given.engine, root)
    address = cluster["cluster"].address if cluster else ""
    command = [sys.executable, __file__, given.engine, str(root), "--drive", "--address", address]
    # Moments are sizes of the list of begins and ends, so that kills are spread over the rows on any machine.
    moments = sorted(random.uniform(0, 0.9) * _BYTES_A_ROW * given.rows for _ in range(given.kills))
    run(command, faults, moments, root)
    tell(batch, root)
    if cluster:
        cluster["cluster"].shutdown()


def start(engine: str, root: Path) -> tuple[dict[str, Any], list[Callable[[], str | None]]]:
    """The engine gets what it needs, such as a Ray of two nodes. The faults that can be made are returned."""
    faults: list[Callable[[], str | None]] = [partial(kill_one, "the driver", "--drive", root)]
    if engine == "slurm":
        faults += [partial(kill_one, "a worker", "submitit.core._submit", root), partial(slurm_command, "scancel")]
        faults += [partial(slurm_command, "scontrol", "requeue")]
    if engine != "ray":
        return {}, faults
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    own = {"num_cpus": _JOBS // 2, "object_store_memory": 80 << 20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=own)
    held = {"cluster": cluster, "node": cluster.add_node(**own)}
    return held, [*faults, partial(kill_one, "a worker", "ray::", root), partial(ray_node, held)]


def run(command: list[str], faults: list[Callable[[], str | None]], moments: list[float], root: Path) -> None:
    """Run the driver to its end, with a fault at each moment. A driver that was killed is started again."""
    began, cpu, peak, made = time.monotonic(), 0.0, 0, Counter[str]()
    while True:
        driver = subprocess.Popen(command, stderr=(root / "driver.log").open("ab"))
        while (ended := os.wait4(driver.pid, os.WNOHANG))[0] == 0:
            time.sleep(0.2)
            if moments and (root / "begins.txt").exists() and (root / "begins.txt").stat().st_size > moments[0]:
                what = random.choice(faults)()
                if what:
                    made[what] += 1
                    moments = moments[1:]
        _, status, used = ended
        cpu, peak = cpu + used.ru_utime + used.ru_stime, max(peak, used.ru_maxrss)
        if not os.WIFSIGNALED(status):
            break
    code = os.waitstatus_to_exitcode(status)
    print(f"exit code {code}, {time.monotonic() - began:.0f} s; driver: {cpu:.0f} s of processor, {peak / 1024:.0f} MB")
    print(f"faults: {dict(made)}")


def tell(batch: Batch, root: Path) -> None:
    """Print what became of the rows."""
    lines = [line.split() for line in (root / "begins.txt").read_text().splitlines()]
    count = {what: Counter(name for kind, name, _ in lines if kind == what) for what in ("begin", "end", "overlap")}
    rows = batch.read_plan()
    states = batch.read_states()
    right = sum(
        (state := states.get(row.name)) is not None
        and state.status == "done"
        and state.runs[0]["psnr"] == float(row.name[3:])
        for row in rows
    )
    once = sum(row.steps[0][0] == "once" for row in rows)
    print(f"{len(rows)} rows: {right} done with the right figure, {len(rows) - right} lost; {once} fail once")
    print(f"began {count['begin'].total()} times; ended twice: {sum(n > 1 for n in count['end'].values())}")
    print(f"twice at once: {count['overlap'].total()}")
    left = [path for path in (root / "states").iterdir() if path.name.startswith(".")]
    print(f"files beside the states (locks, temporary ones): {len(left)}; workspaces: {(root / 'rows').exists()}")
    began = time.monotonic()
    code = "import sys; from mien.cli import main; sys.exit(main(sys.argv[1:]))"
    asked = subprocess.Popen([sys.executable, "-c", code, "batch", "status", str(root)], stdout=subprocess.DEVNULL)
    _, _, used = os.wait4(asked.pid, 0)
    cpu = used.ru_utime + used.ru_stime
    print(f"status: {time.monotonic() - began:.2f} s, {cpu:.2f} s of processor, {used.ru_maxrss / 1024:.0f} MB")
    began = time.monotonic()
    write_results(batch)
    print(f"results: {time.monotonic() - began:.2f} s")


if __name__ == "__main__":
    main()
