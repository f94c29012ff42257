"""Run cases over all targets in processes of their own, and collect the findings by cause in a table.
A process runs many cases in a row, until one ends it. A finding is then tried again alone."""

import faulthandler
import json
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.faults import Place
from fuzzing.judge import Bench, Result, limit_this_process, run_case, snapshot
from fuzzing.kinds import SCRIPT
from fuzzing.targets import TARGETS, Target, present, spread
from mien.errors import UserError
from mien.machine import terminal

BATCH = 150
"""Number of cases in a row in one process."""
_SPARE = 3.0
"""Seconds that a process has to report by itself that a case took too long."""
_GROWN = 400.0
"""Megabytes of memory after which a process takes no further case."""
OUTCOMES = ("refused", "accepted", "finding")


def table_of(results: list[Result]) -> str:
    """Return a table of results by target, then the causes of findings with a case of each."""
    heads = ("target", "cases", *OUTCOMES, "most memory", "longest")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in (*TARGETS, "all"):
        own = [result for result in results if name in (result.case.rsplit(":", 2)[0], "all")]
        counts = [len(own), *(sum(result.outcome == one for result in own) for one in OUTCOMES)]
        memory, longest = (max((getattr(one, part) for one in own), default=0) for part in ("megabytes", "seconds"))
        cells = (name, *(f"{count:,}" for count in counts), f"{memory:,.0f} MB", f"{longest:.1f} s")
        lines += [f"| {' | '.join(cells)} |"] if own else []
    causes: dict[str, list[Result]] = {}
    for result in results:
        if result.outcome == "finding":
            causes.setdefault(result.cause, []).append(result)
    lines += ["", f"{len(causes)} causes:"]
    for cause, found in sorted(causes.items(), key=lambda item: -len(item[1])):
        lines.append(f"{len(found):6} x {cause}    --replay {found[0].case!r}\n{found[0].message[:500]}")
    return "\n".join(lines)


def run(
    seed: int, cases: int, folder: Path, material: Path, only: list[str] | None = None, workers: int = 1,
    until: float | None = None, log: Path | None = None,
) -> list[Result]:  # fmt: skip
    """Run cases over all targets, or over some, and further seeds until `until` (`time.monotonic`)."""
    results, began = list[Result](), time.monotonic()
    while True:
        numbered = [case.format(seed=seed) for case in spread(cases, only or present(material))]
        jobs = [(numbered[index::workers], folder / f"worker{index}", material, until) for index in range(workers)]
        for result in _side_by_side(jobs) if workers > 1 else run_cases(*jobs[0]):
            results.append(result)
            if result.outcome == "finding" and log is not None:
                log.parent.mkdir(parents=True, exist_ok=True)
                with log.open("a") as file:
                    file.write(json.dumps(asdict(result)) + "\n")
            if len(results) % 500 == 0:
                print(f"{len(results)} cases in {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
        seed += 1
        if until is None or time.monotonic() >= until:
            return results


def run_cases(
    cases: list[str], folder: Path, material: Path, until: float | None = None, **limits: Any
) -> Iterator[Result]:
    """Yield results in order. No case starts after `until` (`time.monotonic`); `limits` are those of `Bench`."""
    with socket.create_server(("127.0.0.1", 0), backlog=64) as listener:
        bench, waiting = Bench(folder, material, listener, **limits), list(cases)
        while waiting and (until is None or time.monotonic() < until):
            done = 0
            for result in _batch(waiting[:BATCH], bench):
                done += 1
                if result.outcome == "finding":
                    again = next(_batch([result.case], bench))
                    result.confirmed = again.outcome == "finding"
                    result.traceback = result.traceback or again.traceback
                yield result
            waiting = waiting[done:]


def _forked(work: Callable[..., None], *given: Any) -> tuple[Any, Connection]:
    """Start `work` in another process; return that, and the end of a pipe from which its results come."""
    reading, writing = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=work, args=(writing.send, *given))
    process.start()
    writing.close()
    return process, reading


def _tell_all(tell: Callable[[Result], None], *job: Any) -> None:
    for result in run_cases(*job):
        tell(result)


def _side_by_side(jobs: list[Any]) -> Iterator[Result]:
    """Yield the results of jobs, each in a process of its own, as they come."""
    started = [_forked(_tell_all, *job) for job in jobs]
    waiting: list[Any] = [reading for _, reading in started]
    while waiting:
        for pipe in wait(waiting):
            if isinstance(result := _received(pipe, None), Result):
                yield result
            else:
                waiting.remove(pipe)
    for process, _ in started:
        process.join()
        if process.exitcode:
            raise RuntimeError("a worker of the fuzzer itself failed; what it said is above")


def _received(pipe: Any, patience: float | None) -> Result | str:
    """Return the next result, or how its process ends: by a signal, or not at all."""
    if not pipe.poll(patience):
        return "hang"
    try:
        return pipe.recv()
    except EOFError:
        return "signal"


def _batch(cases: list[str], bench: Bench) -> Iterator[Result]:
    """Yield the results of the first cases, at least of one."""
    here = Path.cwd()
    bench.prepare()
    os.chdir(here)
    before = snapshot(bench)
    process, reading = _forked(_run_in_a_row, cases, bench)
    for case in cases:
        result = _received(reading, bench.patience() + _SPARE)
        if isinstance(result, Result):
            yield result
            continue
        if result == "hang":
            os.killpg(process.pid, signal.SIGKILL)
        process.join()
        if process.exitcode:
            yield _ended(case, bench, before, result, process.exitcode)
        break
    process.join()
    reading.close()


def _run_in_a_row(tell: Callable[[Result], None], cases: list[str], bench: Bench) -> None:
    os.setpgid(0, 0)
    bench.prepare()
    limit_this_process()
    told = os.open(bench.told, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    for stream, target in ((0, os.open(os.devnull, os.O_RDONLY)), (1, told), (2, told)):
        os.dup2(target, stream)
    for case in cases:
        os.ftruncate(told, 0)
        os.lseek(told, 0, os.SEEK_SET)
        faulthandler.dump_traceback_later(bench.patience(), file=sys.__stderr__ or sys.stderr)
        result = run_case(case, bench)
        faulthandler.cancel_dump_traceback_later()
        tell(result)
        if result.megabytes > _GROWN or result.findings:
            break  # later cases must not suffer from it


def _ended(case: str, bench: Bench, before: dict[str, Any], finding: str, code: int) -> Result:
    told = bench.told.read_text(errors="replace")[-4000:] if bench.told.exists() else ""
    lines = [line.strip() for line in told.splitlines() if line.strip()]
    frames = [line.rpartition("/")[2] for line in lines if line.startswith('File "') and "/mien/" in line]
    message = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    findings = [finding] + ["outside"] * (snapshot(bench) != before)
    cause = f"{finding}: {message} at {(frames or [case])[0]}"
    return Result(case, "", "finding", findings, message, cause, lines[:8])


# Readers that are wrong in every way ----------------------------------------------------------------------------------


def _raising(error: Exception) -> Callable[[Path, Path], Any]:
    def read(root: Path, file: Path) -> Any:
        raise error

    return read


def _complain_as_it_comes(root: Path, file: Path) -> None:
    """Print a message without making control characters harmless. It runs in a child, so nobody else sees it."""
    terminal.printable = str  # type: ignore[assignment]
    raise UserError(f"{file}: two\nlines")


WRONG: dict[str, Callable[[Path, Path], Any]] = {
    "signal": lambda root, file: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda root, file: time.sleep(60),
    "memory": lambda root, file: np.ones(100 << 20, np.uint8).sum(),
    "traceback": _raising(KeyError("x")),
    "message": _complain_as_it_comes,
    "nameless": _raising(UserError("a file: cannot be read")),
    "outside": lambda root, file: (root.parent / "outside/victim").write_bytes(b"gone"),
    "leftover": lambda root, file: tempfile.mkdtemp(),
    "connection": lambda root, file: socket.create_connection(("127.0.0.1", int((root / "port").read_text()))),
    "printed": lambda root, file: print("\x1b[2J", file=sys.stderr, flush=True),
    "script": lambda root, file: (root / "report.html").write_text(f"<p>{SCRIPT}</p>"),
}
"""Faulty readers, by the finding that they must cause."""


def missed(folder: Path, material: Path) -> list[str]:
    """Return a line for every faulty reader that the judge would miss."""

    def fault(place: Place, _: Any) -> str:
        (place.root / "port").write_text(str(place.port))
        return "none"

    wrong = []
    for expected, read in WRONG.items():
        TARGETS["wrong"] = Target("wrong", "head.ply", read, fault=fault)
        (result,) = run_cases(["wrong:0:0"], folder, material, seconds=1.5, memory=64 << 20)
        if expected not in result.findings:
            wrong.append(f"wrong by {expected}, but judged {result.outcome} {result.findings} {result.message}")
    del TARGETS["wrong"]
    return wrong
