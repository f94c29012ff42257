"""Run cases in other processes, many in a row until one ends its process. A finding is then tried again alone."""

import faulthandler
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fuzzing.content import content_of
from fuzzing.judge import Bench, Result, limit_this_process, run_case, snapshot
from fuzzing.material import copy_of
from fuzzing.targets import TARGETS, Target

BATCH = 150
"""Number of cases in a row in one process."""
_SPARE = 3.0
"""Seconds that a process has to report by itself that a case took too long."""
_GROWN = 400.0
"""Megabytes of memory after which a process takes no further case."""


def run_cases(
    cases: list[str], folder: Path, material: Path, until: float | None = None, **limits: float
) -> Iterator[Result]:
    """Yield results in order. No case starts after `until` (`time.monotonic`); `limits` are those of `Bench`."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(64)
        port = listener.getsockname()[1]
        bench = Bench(folder / "row", material, port, **limits)  # type: ignore[arg-type]
        other = Bench(folder / "alone", material, port, **limits)  # type: ignore[arg-type]
        waiting = list(cases)
        while waiting and (until is None or time.monotonic() < until):
            done = 0
            for result in _batch(waiting[:BATCH], bench, listener):
                done += 1
                if result.outcome == "finding":
                    again = next(_batch([result.case], other, listener))
                    result.confirmed = again.outcome == "finding"
                    result.traceback = result.traceback or again.traceback
                yield result
            waiting = waiting[done:]


def _batch(cases: list[str], bench: Bench, listener: socket.socket) -> Iterator[Result]:
    """Yield the results of the first cases, at least of one."""
    bench.prepare()
    before = snapshot(bench)
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.setpgid(0, 0)
        _child(cases, bench, listener, writing)
    os.close(writing)
    pending, done, status = b"", 0, None
    while done < len(cases):
        ready, _, _ = select.select([reading], [], [], bench.patience() + _SPARE)
        data = os.read(reading, 1 << 20) if ready else None
        if data:
            *lines, pending = (pending + data).split(b"\n")
            for line in lines:
                done += 1
                yield Result(**json.loads(line))
            continue
        # The case neither ended nor raised an error: its process ended or hangs.
        if data is None:
            os.killpg(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if data is None or os.WIFSIGNALED(status) or os.waitstatus_to_exitcode(status) != 0:
            yield _ended(cases[done], bench, before, "hang" if data is None else "signal", status)
        break
    os.close(reading)
    if status is None:
        os.waitpid(child, 0)


def _child(cases: list[str], bench: Bench, listener: socket.socket, writing: int) -> None:
    """Run cases, write a line for each, and end this process."""
    code = 1
    try:
        limit_this_process()
        expected = _Expected(bench)
        told = os.open(bench.told, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(told, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for case in cases:
            os.ftruncate(told, 0)
            os.lseek(told, 0, os.SEEK_SET)
            (bench.folder / "case.txt").write_text(case)
            faulthandler.dump_traceback_later(bench.patience(), file=sys.__stderr__ or sys.stderr)
            result = run_case(case, bench, listener, expected)
            faulthandler.cancel_dump_traceback_later()
            os.write(writing, json.dumps(result.as_json()).encode() + b"\n")
            if result.megabytes > _GROWN or result.findings:
                break  # later cases must not suffer from it
        code = 0
    except BaseException as error:
        print(f"the fuzzer itself failed: {error!r}", file=sys.stderr, flush=True)
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


class _Expected:
    """Content of each undamaged file, which is read once per process."""

    def __init__(self, bench: Bench) -> None:
        self._bench, self._known = bench, {}

    def __call__(self, target: Target, file: Path) -> Any:
        key = (target.name, str(file))
        if key not in self._known:
            root = self._bench.folder / "whole"
            if not root.exists():
                copy_of(self._bench.material, ("W", "head.mien"), root)
            self._known[key] = content_of(target.read(root, root / file.relative_to(self._bench.root)))
        return self._known[key]


def _ended(case: str, bench: Bench, before: dict[str, Any], finding: str, status: int) -> Result:
    """Return the result of a case that ended its process."""
    told = bench.told.read_text(errors="replace")[-4000:] if bench.told.exists() else ""
    result = Result(case, TARGETS[case.rsplit(":", 2)[0]].format, outcome="finding", findings=[finding])
    by_signal = os.WIFSIGNALED(status)
    result.message = (
        signal.Signals(os.WTERMSIG(status)).name if by_signal else f"exit code {os.waitstatus_to_exitcode(status)}"
    )
    result.traceback = [line.strip() for line in told.splitlines() if line.strip()][:8]
    frames = [line for line in told.splitlines() if line.strip().startswith('File "') and "/mien/" in line]
    place = frames[0].strip().rpartition("/")[2] if frames else case.split(":")[0]
    place = place.replace('"', "")
    result.cause = f"{finding}: {result.message} at {place}"
    if snapshot(bench) != before:
        result.findings.append("outside")
    return result
