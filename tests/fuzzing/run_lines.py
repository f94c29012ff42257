"""Run odd command lines as real processes, and judge how they end."""

import contextlib
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.command_lines import Line, make_line
from fuzzing.faults import Place
from fuzzing.judge import MEMORY, Bench, Result, judge_traces, snapshot
from fuzzing.material import copy_of

PARTS = (
    "W",
    "given",
    "pictures",
    "videos",
    "flame",
    "gaussian_avatars",
    "flame_avatars",
    "head.mien",
    "head.ply",
    "cache",
)
LINES, LIGHT, HEAVY = "command lines", "line", "heavy line"
"""Name of the format in the table, and prefixes of the names of its cases."""
FINE = frozenset({0, 2, 129, 130, 141, 143})
"""Exit codes of success, of a mistake of the user, and of SIGHUP, SIGINT, SIGPIPE and SIGTERM."""
TESTS = str(Path(__file__).parent.parent)
APART = 0.08
"""Share of the lines that run in a new process instead of a fork, whether or not they need one."""
_SECONDS = 60.0
"""Seconds that a command on small input may need on a busy machine. Commands that take longer are then stopped."""
_TO_END = 20.0
"""Seconds that a command has to end after a signal."""


class Server:
    """Client of `fuzzing.command_server`."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzzing.command_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            env={**os.environ, "PYTHONPATH": TESTS},
        )

    def run(self, request: dict[str, Any], line: Line) -> tuple[int | None, int]:
        """Run a line, and return its exit code (None if it hung) and the most megabytes that it took."""
        in_time = _wait(self.start(request), line, request, self.ended)
        code, megabytes = self.result()
        return (code if in_time else None), megabytes

    def start(self, request: dict[str, Any]) -> int:
        """Start a command, and return the number of its process."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        return int(self._process.stdout.readline())

    def ended(self, seconds: float) -> bool:
        """Wait at most so long for the command that was started last; return whether it has ended."""
        assert self._process.stdout is not None
        return bool(select.select([self._process.stdout], [], [], seconds)[0])

    def result(self) -> tuple[int, int]:
        """Return the exit code of the command that has ended, and the most megabytes that it took."""
        assert self._process.stdout is not None
        code, megabytes = json.loads(self._process.stdout.readline())
        return code, megabytes

    def close(self) -> None:
        """Stop the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def run_lines(cases: list[str], folder: Path, material: Path) -> Iterator[Result]:
    """Yield the results of command lines in order."""
    if not cases:
        return
    server = Server()
    try:
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            listener.listen(64)
            bench = Bench(folder, material, listener.getsockname()[1])
            for case in cases:
                result = run_line(case, bench, server, listener)
                if result.outcome == "finding":
                    result.confirmed = run_line(case, bench, server, listener).outcome == "finding"
                yield result
    finally:
        server.close()


def run_line(case: str, bench: Bench, server: Server, listener: socket.socket) -> Result:
    """Make, run and judge one command line."""
    dice, result = Random(case), Result(case, LINES)
    bench.prepare()
    copy_of(bench.material, PARTS, bench.root)
    os.mkfifo(bench.root / "pipe")
    (bench.root / "empty").touch()
    (bench.root / "outside_link").symlink_to(bench.folder / "nowhere")
    place = Place(bench.root, bench.root / "W", bench.canary, bench.port)
    line = make_line(place, dice, case.startswith(HEAVY))
    result.kind, result.message = " ".join([*line.words[:1], *(["(heavy)"] if line.heavy else [])]), line.text()
    before, began = snapshot(bench, home=False), time.monotonic()
    request = _request(line, bench)
    apart = line.apart or dice.random() < APART
    code, megabytes = _run_apart(request, line) if apart else server.run(request, line)
    result.seconds, result.megabytes = round(time.monotonic() - began, 2), 0.0
    told = (
        (bench.folder / "told.txt").read_text(errors="surrogateescape") if (bench.folder / "told.txt").exists() else ""
    )
    result.outcome = {0: "accepted", 2: "refused"}.get(code if code is not None else -999, "stopped")
    result.findings = list(_faults_of_end(code, told, line))
    if megabytes > MEMORY / 2**20 + 700 and not line.heavy:  # in addition to the imported modules
        result.findings.append("memory")
    # The libraries of a command may keep caches in the home folder, and a line is stopped before it is slow.
    cause = _cause(code, told, line)
    judge_traces(result, bench, before, listener, home=False, slow=False)
    if result.findings:
        result.outcome = "finding"
        result.traceback = [*result.traceback, f"exit code {code}, {megabytes} MB", *told.splitlines()[-12:]]
        result.cause = f"line: {'+'.join(result.findings)}, {cause}"
    return result


def _request(line: Line, bench: Bench) -> dict[str, Any]:
    around = line.surroundings
    env = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", *around.get("without", ()))}
    env |= {"MIEN_CACHE": str(bench.root / "cache"), "MIEN_THREADS": "1", **around.get("env", {})}
    if "HOME" in around.get("without", ()) or "HOME" in around.get("env", {}):
        del env["MIEN_CACHE"]
    told = str(bench.folder / "told.txt")
    places = {"full": "/dev/full", None: os.devnull}
    request = {"words": line.words, "env": env, "folder": str(bench.root), "stderr": around.get("stderr", told)}
    request |= {"stdin": around.get("stdin", os.devnull), "stdout": around.get("stdout", told)}
    request["stdout"] = places.get(request["stdout"], request["stdout"])
    return request | {name: around[name] for name in ("largest_file", "open_files", "memory") if name in around}


def _run_apart(request: dict[str, Any], line: Line) -> tuple[int | None, int]:
    """Run a line in a new process, as a shell does."""
    source = "import json, os, sys; from fuzzing.command_server import prepare; asked = json.loads(sys.argv[1]); "
    source += (
        "prepare(asked); os.execve(sys.executable, [sys.executable, '-m', 'mien.cli', *asked['words']], os.environ)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", source, json.dumps(request)], env={**os.environ, "PYTHONPATH": TESTS}
    )

    def ended(seconds: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
            return True
        return False

    in_time = _wait(process.pid, line, request, ended)
    process.wait()
    return (process.returncode if in_time else None), 0


def _wait(child: int, line: Line, request: dict[str, Any], ended: Any) -> bool:
    """Wait for a process to end. Signal it if the line asks for that or it takes too long. Return False if it hangs."""
    number = line.surroundings.get("signal")
    if number is not None and not ended(0.05 + (sum(map(len, line.words)) % 20) / 10):
        _tell(child, number)
    if ended(_SECONDS):
        return True
    # The line may ask for many frames. Files that keep a reader busy are found by the cases of that reader.
    line.surroundings = {**line.surroundings, "signal": signal.SIGTERM}
    _tell(child, signal.SIGTERM)
    if ended(_TO_END):
        return True
    _tell(child, signal.SIGKILL)
    return False


def _tell(child: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, number)


def _faults_of_end(code: int | None, told: str, line: Line) -> Iterator[str]:
    if code is None:
        yield "hang"
        return
    sent = line.surroundings.get("signal")
    if code < 0 and -code not in (signal.SIGPIPE, sent):
        yield "signal"
    elif code >= 0 and code not in FINE:
        yield "exit code"
    # Python prints this itself if Ctrl-C arrives between two of its own steps.
    if "Traceback (most recent call last)" in told and not (sent == signal.SIGINT and "Exception ignored in" in told):
        yield "traceback"
    lines = [text for text in told.splitlines() if text.startswith("mien: ")]
    if (
        code == 2
        and len(lines) != 1
        and line.surroundings.get("stderr") != "closed"
        and "largest_file" not in line.surroundings
    ):
        yield "lines"


def _cause(code: int | None, told: str, line: Line) -> str:
    """Return the cause of a finding: the end of its traceback, or else the command and its surroundings."""
    text = told
    for log in re.findall(r"the traceback is in (\S+);", told):
        with contextlib.suppress(OSError):
            text += Path(log).read_text(errors="replace")
    frames = re.findall(r'File "[^"]*/mien/([^"]+)", line \d+, in (\S+)', text)
    errors = [each for each in text.splitlines() if re.match(r"^[A-Za-z_.]+(Error|Exception|Interrupt)\b", each)]
    where = (
        f"{Path(frames[-1][0]).name}:{frames[-1][1]}"
        if frames
        else f"{line.words[0] if line.words else ''}, {line.names[:1]}"
    )
    return f"exit {code}: {errors[-1].split(':')[0] if errors else ''} in {where}"
