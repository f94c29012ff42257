"""Run one case from its fault to its verdict, in a fresh process or after other cases."""

import contextlib
import hashlib
import io
import os
import re
import resource
import select
import shutil
import socket
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from fuzzing.content import content_of
from fuzzing.edges import SCRIPT
from fuzzing.faults import DAMAGE, Place
from fuzzing.material import copy_of
from fuzzing.place_faults import outside_of
from fuzzing.targets import TARGETS, Target
from mien import cli
from mien.errors import UserError

SECONDS = 20.0
"""Longest time that a case may take, in seconds."""
MEMORY = 2 << 30
"""Most bytes that a case may hold."""
LIMIT = 5 << 30
"""Bytes beyond which the system refuses. It is more than `MEMORY`, so that cases that would take them are seen."""
LARGEST_FILE = 4 << 30
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e]")
_INNER = ("site-packages", "fuzzing/", "lib/python")


@dataclass(frozen=True)
class Bench:
    """Folders in which a worker runs its cases."""

    folder: Path
    material: Path
    port: int
    seconds: float = SECONDS
    memory: int = MEMORY

    @property
    def root(self) -> Path:
        return self.folder / "case"

    @property
    def canary(self) -> Path:
        return self.folder / "outside"

    @property
    def told(self) -> Path:
        """File with the output of the case."""
        return self.folder / "told.txt"

    def patience(self) -> float:
        """Return the seconds after which a case hangs; they are longer if others keep the machine busy."""
        return self.seconds * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1) - 1)

    def prepare(self) -> None:
        """Make fresh folders, and an environment that keeps the user's own files out of reach."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for name in ("home", "here", "tmp"):
            (self.folder / name).mkdir(parents=True)
        outside_of(self.canary)
        os.environ.update(
            HOME=str(self.folder / "home"), TMPDIR=str(self.folder / "tmp"), MIEN_CACHE=str(self.folder / "cache"),
            MPLCONFIGDIR=str(self.material.parent / "matplotlib"),  # charts need a list of fonts, which all cases share
        )  # fmt: skip
        tempfile.tempdir = None
        os.chdir(self.folder / "here")


@dataclass
class Result:
    """Verdict on a case."""

    case: str
    """Name of the case: TARGET:SEED:NUMBER."""
    format: str
    kind: str = ""
    """Kind of the fault."""
    outcome: str = ""
    """Outcome: refused, accepted or finding."""
    findings: list[str] = field(default_factory=list)
    message: str = ""
    cause: str = ""
    """Name of the cause; findings with the same origin share it."""
    traceback: list[str] = field(default_factory=list)
    seconds: float = 0.0
    megabytes: float = 0.0
    """Most memory beyond the process's own at the start."""
    confirmed: bool | None = None
    """Whether the finding was repeated in a process of its own."""

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def limit_this_process() -> None:
    """Set the limits that hold for all cases of a process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + LIMIT, size + LIMIT))


def run_case(case: str, bench: Bench, listener: socket.socket, expected: Callable[[Target, Path], Any]) -> Result:
    """Make a fault, read the file, use the result, and judge."""
    name, seed, number = case.rsplit(":", 2)
    target, dice = TARGETS[name], Random(case)
    result = Result(case, target.format)
    shutil.rmtree(bench.root, ignore_errors=True)
    copy_of(bench.material, target.parts, bench.root)
    files = sorted(path for path in bench.root.glob(target.files) if not path.is_dir() or target.format == "workspace")
    place = Place(bench.root, files[int(number) % len(files)], bench.canary, bench.port)
    whole = place.file
    result.kind = target.fault(place, dice)
    before, memory = snapshot(bench), _forget_peak()
    began = time.monotonic()
    try:
        found = target.read(bench.root, place.file)
        if result.kind == DAMAGE and target.exact:
            assert content_of(found) == expected(target, whole), "read something else than what was written"
        target.use(bench.root, found, dice)
        result.outcome = "accepted"
    except UserError as error:
        result.outcome, result.message = "refused", str(error)
        result.findings += _faults_of_message(str(error), str(bench.root) if target.named else "")
        if result.findings:
            _add_traceback(result, error)
    except BaseException as error:
        result.findings.append("memory" if isinstance(error, MemoryError) else "traceback")
        result.message = " ".join(f"{type(error).__name__}: {error}".split())[:2000]
        _add_traceback(result, error)
    result.seconds = round(time.monotonic() - began, 3)
    result.megabytes = round((_peak() - memory) / 2**20, 1)
    judge_traces(result, bench, before, listener)
    if result.findings:
        result.outcome = "finding"
        result.cause = result.cause or f"{'+'.join(result.findings)} in {name}, {result.kind}"
    return result


def snapshot(bench: Bench, home: bool = True) -> dict[str, Any]:
    """Return the state of everything outside of the copies, with or without the home folder."""
    found: dict[str, Any] = {}
    for folder in (bench.canary, bench.folder / "here", *([bench.folder / "home"] if home else [])):
        for path in sorted([folder, *folder.rglob("*")]):
            status = path.lstat()
            whole = path.is_file() and not path.is_symlink()
            digest = (
                hashlib.sha256(path.read_bytes()).hexdigest() if whole and status.st_size < LARGEST_FILE / 64 else None
            )
            found[str(path.relative_to(bench.folder))] = (
                status.st_mode,
                digest,
                None if path.is_dir() else status.st_mtime_ns,
            )
    return found


def judge_traces(
    result: Result,
    bench: Bench,
    before: dict[str, Any],
    listener: socket.socket,
    home: bool = True,
    slow: bool = True,
) -> None:
    """Add findings if the case left files, wrote outside, opened a connection or printed control characters."""
    if (after := snapshot(bench, home)) != before:
        changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
        result.findings.append("outside")
        result.traceback.append(f"changed: {changed}")
        result.cause = result.cause or f"outside: {result.case.split(':')[0]}, {result.kind}"
    if slow and result.seconds > bench.patience():
        result.findings.append("hang")
    if result.megabytes > bench.memory / 2**20:
        result.findings.append("memory")
    if select.select([listener], [], [], 0)[0]:
        listener.accept()[0].close()
        result.findings.append("connection")
    leftovers = sorted(
        path.name for path in (bench.folder / "tmp").iterdir() if not path.name.startswith("mien-crash-")
    )
    if leftovers and result.outcome != "finding":
        result.findings.append("leftover")
        result.traceback.append(f"left in the folder for temporary files: {leftovers}")
    told = bench.told.read_text(errors="surrogateescape") if bench.told.exists() else ""
    if _CONTROL.search(told.replace("\r", "")):
        result.findings.append("printed")
        result.traceback.append(f"printed: {ascii(told[-300:])}")
    for report in bench.root.rglob("*.html"):
        with contextlib.suppress(OSError):
            if not report.is_file() or report.is_symlink() or report.stat().st_size > LARGEST_FILE / 64:
                continue  # a fault may have made it longer than memory
            if SCRIPT in report.read_text(errors="replace"):
                result.findings.append("script")
    if leftovers:
        shutil.rmtree(bench.folder / "tmp")
        (bench.folder / "tmp").mkdir()


def _faults_of_message(message: str, root: str) -> list[str]:
    printed = io.StringIO()
    with contextlib.redirect_stderr(printed):
        cli._complain(message)  # what reaches the terminal counts, where names are made harmless
    line = printed.getvalue().removesuffix("\n")
    lines = "message" if "\n" in line or _CONTROL.search(line) else ""
    nameless = "nameless" if root not in message else ""
    return [fault for fault in (lines, nameless, "long message" if len(message) > 3000 else "") if fault]


def _add_traceback(result: Result, error: BaseException) -> None:
    frames = traceback.extract_tb(error.__traceback__)
    result.traceback = [
        f"{Path(frame.filename).name}:{frame.lineno} {frame.name}: {(frame.line or '').strip()[:120]}"
        for frame in frames
    ][-6:]
    ours = [frame for frame in frames if "/mien/" in frame.filename]
    last = ours[-1] if ours else frames[-1]
    result.cause = f"{'+'.join(result.findings)}: {type(error).__name__} in {Path(last.filename).name}:{last.name}"
    if type(error).__name__ == "CommandError":
        logged = re.findall(r'File "[^"]*/mien/([^"]+)", line \d+, in (\w+)', str(error))
        kind = re.findall(r"^(\w[\w.]*):? ?", str(error).strip().rpartition("\n")[2])
        where = f"{Path(logged[-1][0]).name}:{logged[-1][1]}" if logged else result.message[:60]
        result.cause = f"traceback: {kind[0] if kind else ''} in {where}"


def _forget_peak() -> int:
    """Reset the recorded peak of this process's memory, and return what it holds now."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _status(name: str) -> int:
    text = Path("/proc/self/status").read_text()
    return int(re.search(rf"{name}:\s+(\d+)", text)[1]) * 1024  # type: ignore[index]
