"""One row: the claim on it, its steps, its state, its figures; and the process in which it runs.

`run_row` runs in a process of its own, so that a row that needs too much memory fails alone. That process holds the
row's lock and runs the steps itself: whatever kills it frees the lock and leaves nothing behind. `attempt` starts it
and waits for it, wherever an engine calls it. If `attempt` dies, the row's standard input ends, and the row stops.
"""

import json
import math
import os
import shlex
import signal
import socket
import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import mien
from mien.batch.plan import Batch, Row, State
from mien.batch.store import fetched
from mien.disk.config import decode
from mien.disk.files import write_atomically
from mien.disk.locks import BeingWrittenError, hold
from mien.disk.reading import open_to_append, open_to_read
from mien.disk.workspace import Workspace
from mien.errors import CannotWriteError, UserError
from mien.machine.progress import current_stage
from mien.machine.stops import orderly_stops
from mien.machine.system import end_this_process, peak_memory_mb
from mien.machine.terminal import printable, tell

Do = Callable[[Batch, Row], tuple[tuple[dict[str, Any], ...], dict[str, float]]]
"""Runs the steps of a row, and returns the figures of its runs and the seconds of its stages."""
EXIT_BUSY = 75
"""Exit code of a row's process if another process holds the row."""
Main = Callable[[list[str]], int]
"""Runs a command of mien and returns its exit code."""
_VIEWS, _SIDE = 12, 160
"""Number of pictures in a thumbnail, and their sides in pixels."""
_waited_for: dict[subprocess.Popen[bytes], bool] = {}
"""Processes of rows that `attempt` waits for, in any thread of this process, and whether each was told to stop."""


class RowFailedError(Exception):
    """A step of a row has failed. The text is its error, in one line."""


def run_row(batch: Batch, row: Row, do: Do, patience: float = 0.0) -> State | None:
    """Claim a row and run it, unless it is done. Return its state, or None if another process holds the row.

    `patience` has the seconds to wait for the claim.
    """
    until = time.monotonic() + patience
    while True:
        try:
            with hold(batch.state_file(row.name)):
                return _claimed(batch, row, do)
        except BeingWrittenError:
            if time.monotonic() >= until:
                return None
            time.sleep(0.5)


def _claimed(batch: Batch, row: Row, do: Do) -> State | None:
    if batch.is_done(row):
        return batch.read_state(row.name)
    here = f"{socket.gethostname()}, process {os.getpid()}"
    state = State(row.name, "running", row.fingerprint, batch.tries(row) + 1, here, time.time(), mien=mien.__version__)
    batch.write_state(state)
    try:
        runs, stages = do(batch, row)
        state = replace(state, status="done", runs=runs, stages=stages)
    except RowFailedError as error:
        state = replace(state, status="failed", error=printable(str(error)))
    state = replace(state, seconds=round(time.time() - state.began, 2), peak_mb=float(round(peak_memory_mb())))
    batch.write_state(state)
    return state


def attempt(root: Path, program: Sequence[str], threads: int | None, row: Row) -> State | None:
    """Run a row in a process of its own and wait for it. Return its state.

    None if another process holds the row, or if `stop_attempts` stopped it, which then counts as interrupted.
    `program` is the command of the row's process, which the folder of the batch (`root`) follows. Without `threads`,
    MIEN_THREADS stays as it is.
    """
    batch = Batch(root)
    log = batch.log_file(row.name)
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ) | ({"MIEN_THREADS": str(threads)} if threads else {})
    started = time.time()
    with open_to_append(log) as out:
        printed = os.fstat(out.fileno()).st_size
        process = subprocess.Popen(
            [*program, str(root)], stdin=subprocess.PIPE, stdout=out, stderr=out, env=environment, close_fds=True
        )
    assert process.stdin is not None
    with suppress(OSError):  # it has ended already
        process.stdin.write(json.dumps(asdict(row)).encode() + b"\n")
        process.stdin.flush()
    _waited_for[process] = False
    try:
        code = process.wait()
    finally:
        stopped = _waited_for.pop(process)
        with suppress(OSError):
            process.stdin.close()
        process.wait()
    return None if stopped or code == EXIT_BUSY else _concluded(batch, row, code, started, printed)


def stop_attempts() -> None:
    """Let the processes of all rows that this process waits for stop, as if it had ended. Does not wait for them."""
    for process in list(_waited_for):
        _waited_for[process] = True
        assert process.stdin is not None
        with suppress(OSError):
            process.stdin.close()


def _concluded(batch: Batch, row: Row, code: int, started: float, printed: int) -> State | None:
    """The state after the row's process has ended. If it could not write one itself, this writes why.

    A failure from before `started` is of an earlier try. The log had `printed` bytes at that time.
    """

    def told(state: State | None) -> bool:
        if state is None or state.fingerprint != row.fingerprint:
            return False
        return state.status == "done" or (state.status == "failed" and state.began >= started)

    found = batch.read_state(row.name)
    if not code and told(found):
        return found  # the row's process wrote it; a lock would double the operations on a shared file system
    with suppress(BeingWrittenError), hold(batch.state_file(row.name)):
        state = batch.read_state(row.name)
        if told(state):
            return state
        if state is None or state.fingerprint != row.fingerprint or state.began < started:  # it had not even claimed it
            state = State(row.name, "failed", row.fingerprint, batch.tries(row) + 1, began=started)
        seconds = round(time.time() - state.began, 2)
        failed = replace(state, status="failed", seconds=seconds, error=_why(batch, row, code, printed))
        with suppress(CannotWriteError):  # the disk is full; the engine tells of the state all the same
            batch.write_state(failed)
        return failed
    return None


def _why(batch: Batch, row: Row, code: int, printed: int) -> str:
    if code < 0:
        name = signal.Signals(-code).name
        hint = f"; it may have needed more memory than the {row.memory_mb / 1000:.1f} GB that were counted"
        return f"its process was ended by {name}{hint if name == 'SIGKILL' else ''}; run the row again"
    silent = f"its process printed nothing and ended with exit code {code}; correct --program, or run the row again"
    return last_error(batch.log_file(row.name), printed) or silent


def last_error(log: Path, since: int = 0) -> str:
    """The last line of a log, after its first `since` bytes, in which mien reports an error; else its last line."""
    lines = [line for line in tail(log, since).splitlines() if line.strip()]
    errors = [line.removeprefix("mien: ") for line in lines if line.startswith("mien: ")]
    return printable((errors or lines or [""])[-1])[:500]


def tail(log: Path, since: int = 0, most: int = 8192) -> str:
    """The last `most` bytes of a log, without its first `since` bytes. Empty if it cannot be read."""
    try:
        with open_to_read(log) as file:
            file.seek(max(since, file.seek(0, os.SEEK_END) - most))
            return file.read().decode("utf-8", "replace")
    except (OSError, UserError):
        return ""


def row_process(root: Path, given: IO[str], do: Do) -> int:
    """Be the process of the row that is given as the first line of `given`, and stop when `given` ends."""
    try:
        row = decode(Row, json.loads(given.readline()))
    except ValueError:
        raise UserError("standard input holds no row; `mien batch` starts this process, and gives it one") from None
    threading.Thread(target=_stop_at_end, args=(given,), daemon=True).start()
    try:
        with orderly_stops():
            state = run_row(Batch(root), row, do, 15.0)  # who held the row may be about to end: its node was lost
    except UserError as error:
        tell(f"mien: {error}")
        return 2
    return EXIT_BUSY if state is None else 0


def _stop_at_end(given: IO[str]) -> None:
    """Stop this process if the one that waits for it is gone: in good order, or by force if it does not follow."""
    given.read()
    end_this_process()
    time.sleep(10)
    os._exit(143)


def repeat_command(batch: Batch, row: Row) -> str:
    """The commands that repeat a row here, for a shell."""
    return " && ".join(shlex.join(["mien", *batch.words(row, step)]) for step in row.steps)


def do_steps(main: Main, batch: Batch, row: Row) -> tuple[tuple[dict[str, Any], ...], dict[str, float]]:
    """Run the steps of a row with `main`, as `Do` does."""
    workspace = batch.workspace(row.name)
    stages: defaultdict[str, float] = defaultdict(float)
    for number, step in enumerate(row.steps, 1):
        if step[0] != "create":  # which tells of stages of its own
            named = [f" {word}" for flag, word in pairwise(step) if flag in ("--run", "--method")][:1]
            tell(f"stage {number} of {len(row.steps)} ({''.join([step[0], *named])})")
        words = [fetched(word, batch.place("inputs")) for word in batch.words(row, step)]
        ended = threading.Event()
        sampler = threading.Thread(target=_sample, args=(step[0], stages, ended), daemon=True)
        sampler.start()
        try:
            code = main(words)
        finally:
            ended.set()
            sampler.join()
        if code >= 128:
            raise SystemExit(code)  # it was told to stop
        if code:
            raise RowFailedError(last_error(batch.log_file(row.name)))
    found = Workspace(workspace)
    runs = tuple(figures_of(batch, row.name, found.run_dir(name)) for name in found.run_names())
    return runs, {name: round(seconds, 1) for name, seconds in stages.items()}


def _sample(step: str, stages: dict[str, float], ended: threading.Event) -> None:
    """Add up the seconds of each stage of a step while it runs."""
    before = time.monotonic()
    while not ended.wait(0.5):
        now = time.monotonic()
        stages[current_stage() or step] += now - before
        before = now
    stages[current_stage() or step] += time.monotonic() - before


def figures_of(batch: Batch, name: str, run_dir: Path) -> dict[str, Any]:
    """The figures of a run as they come into the results: one value each. Writes the run's thumbnail as well."""
    from mien.evaluation.metrics_file import figure, read_metrics
    from mien.pages.pages import METRICS
    from mien.training.run import read_run_config

    found: dict[str, Any] = {"run": run_dir.name, "method": read_run_config(run_dir)["method"]["kind"]}
    if (run_dir / "metrics.json").is_file():
        content = read_metrics(run_dir)
        scored = next((each for each in content["protocols"].values() if "psnr" in each), None)
        for part, prefix in ((None, ""), ("head", "head_")):
            for metric in METRICS:
                found[prefix + metric] = None if scored is None else figure(scored, part, metric)
        found |= protocol_figures(content["protocols"])
        found |= {key: content["training"].get(key) for key in ("gaussians", "steps", "seconds")}
        found["training_seconds"] = seconds = found.pop("seconds")
        found["training_hours"] = None if seconds is None else seconds / 3600
    if (run_dir / "film.mp4").is_file():
        thumbnail = batch.place("thumbs", f"{name}.{run_dir.name}.jpg")
        write_atomically(thumbnail, partial(write_strip, run_dir / "film.mp4"))
    return found


def protocol_figures(protocols: Mapping[str, Any]) -> dict[str, float]:
    """The figures of each protocol by its name, a dot and theirs; and with fitted faces, if those were scored.

    MonoGaussianAvatar's protocol erodes and dilates drawings of fitted faces (`opened`).
    """
    found: dict[str, float] = {}
    for name, entry in protocols.items():
        place = "self_reenactment" if name.startswith("self_reenactment") else name
        fitted = entry.get("opened", entry["fitted"]) if "fitted" in entry else {}
        for prefix, part in ((place, entry), (f"{place}.fitted", fitted)):
            numbers = {key: value for key, value in part.items() if isinstance(value, float) and math.isfinite(value)}
            found = {f"{prefix}.{key}": value for key, value in numbers.items()} | found
    return found


def write_strip(film: Path, path: Path) -> None:
    """Write pictures of a film side by side."""
    from PIL import Image

    from mien.media.video_file import open_video

    with open_video(film) as (container, stream):
        frames = [frame.to_image() for frame in container.decode(stream)]
    chosen = [frames[index * len(frames) // _VIEWS] for index in range(_VIEWS)]
    strip = Image.new("RGB", (_SIDE * _VIEWS, _SIDE))
    for index, frame in enumerate(chosen):
        strip.paste(frame.resize((_SIDE, _SIDE)), (index * _SIDE, 0))
    strip.save(path, "JPEG", quality=80)
