"""Run one case from its fault to its verdict: a line of complaint that names the file, or content that can be used."""

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
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from torch import Tensor, nn

from fuzzing import uses
from fuzzing.faults import DAMAGE, FIXED, Place, outside_of
from fuzzing.kinds import SCRIPT
from fuzzing.material import copy_of
from fuzzing.targets import TARGETS, Target
from fuzzing.values import SANE, VALUES, concrete, edit
from mien.errors import UserError
from mien.machine.terminal import tell

SECONDS = 20.0
"""Longest time of the processor that a case may take, in seconds: others may keep the machine busy."""
_ASLEEP = 10
"""How many times as long a case may last that does not use the processor."""
MEMORY = 2 << 30
"""Most bytes that a case may hold."""
LIMIT = 5 << 30
"""Bytes beyond which the system refuses. It is more than `MEMORY`, so that cases that would take them are seen."""
_LARGEST_FILE = 4 << 30
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e]")


@dataclass
class Bench:
    """Folders in which cases run."""

    folder: Path
    material: Path
    listener: socket.socket
    """Socket to which nothing may connect."""
    seconds: float = SECONDS
    memory: int = MEMORY
    expected: dict[str, Any] = field(default_factory=dict)
    """Content of undamaged files, by target and file."""

    def __post_init__(self) -> None:
        self.root, self.canary = self.folder / "case", self.folder / "outside"
        self.told = self.folder / "told.txt"
        """File with the output of the case."""

    def patience(self) -> float:
        """Return the seconds after which a case is ended."""
        return _ASLEEP * self.seconds

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
    """TARGET:SEED:NUMBER."""
    kind: str = ""
    """Kind of the fault."""
    outcome: str = ""
    """refused, accepted or finding."""
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


def limit_this_process() -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + LIMIT, size + LIMIT))


def run_case(case: str, bench: Bench) -> Result:
    """Make a fault, read the file, use the result, and judge."""
    name, seed, number = case.rsplit(":", 2)
    target, dice = TARGETS[name], Random(case)
    os.chdir(bench.folder / "here")
    shutil.rmtree(bench.root, ignore_errors=True)
    copy_of(bench.material, target.needs, bench.root)
    files = sorted(path for path in bench.root.glob(target.files) if not path.is_dir() or "**" in target.files)
    place = Place(bench.root, files[int(number) % len(files)], bench.canary, bench.listener.getsockname()[1])
    if seed.isdigit() or seed in FIXED:
        fault = (lambda: FIXED[seed](place)) if seed in FIXED else lambda: target.fault(place, dice)
        return judge(target, Result(case), bench, place, fault, dice)
    row, _, index = seed.partition("/")
    rows = [SANE[name]] if row == "sane" else concrete(VALUES[name][int(row)], place.file)
    where, value = rows[int(index or 0)]
    data = edit(place.file, where, value)
    if data is None:
        return Result(case, outcome="no such place")
    place.write(data)
    if row == "sane":
        evaluated = target.use in (uses.use_run, uses.use_evaluation)
        target = replace(target, use=uses.use_evaluation if evaluated else uses.nothing)
    result = judge(target, Result(case), bench, place, lambda: f"{where} = {value!r}"[:200], dice)
    if result.outcome == ("refused" if row == "sane" else "accepted"):
        result.findings, result.cause = [result.outcome], f"{name}: {result.kind} is {result.outcome}"
        result.outcome = "finding"
    return result


def judge(target: Target, result: Result, bench: Bench, place: Place, fault: Callable[[], str], dice: Random) -> Result:
    """Make the fault, read the file, use the result, and complete the verdict."""
    whole = place.file
    result.kind = fault()
    before, memory, began = snapshot(bench), _forget_peak(), time.process_time()
    try:
        found = target.read(bench.root, place.file)
        if result.kind == DAMAGE and target.exact:
            assert content_of(found) == _expected(target, whole, bench), "read something else than what was written"
        target.use(bench.root, found, dice)
        result.outcome = "accepted"
    except UserError as error:
        result.outcome, result.message = "refused", str(error)
        result.findings += faults_of_message(str(error), str(bench.root) if target.named else "")
        if result.findings:
            _add_traceback(result, error)
    except BaseException as error:
        result.findings.append("memory" if isinstance(error, MemoryError) else "traceback")
        result.message = " ".join(f"{type(error).__name__}: {error}".split())[:2000]
        _add_traceback(result, error)
    result.seconds = round(time.process_time() - began, 3)
    result.megabytes = round((_status("VmHWM") - memory) / 2**20, 1)
    _judge_traces(result, bench, before)
    if result.findings:
        result.outcome = "finding"
        result.cause = result.cause or f"{'+'.join(result.findings)} in {target.name}, {result.kind}"
    return result


def _expected(target: Target, file: Path, bench: Bench) -> Any:
    """Return the content of an undamaged file, which is read once per process."""
    key = f"{target.name} {file}"
    if key not in bench.expected:
        root = bench.folder / "whole"
        shutil.rmtree(root, ignore_errors=True)
        copy_of(bench.material, target.needs, root)
        bench.expected[key] = content_of(target.read(root, root / file.relative_to(bench.root)))
    return bench.expected[key]


def content_of(value: Any) -> Any:
    """Return a value in a form that can be compared."""
    if isinstance(value, nn.Module):
        return content_of(dict(value.state_dict()))
    if isinstance(value, Tensor):
        return content_of(value.detach().numpy())
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value):
        return {field.name: content_of(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: content_of(item) for name, item in value.items()}
    return [content_of(item) for item in value] if isinstance(value, (tuple, list)) else value


def snapshot(bench: Bench) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for folder in (bench.canary, bench.folder / "here", bench.folder / "home"):
        for path in (folder, *folder.rglob("*")):
            status = path.lstat()
            digest = hashlib.sha256(path.read_bytes()).hexdigest() if _is_small(path) else None
            changed = None if path.is_dir() else status.st_mtime_ns
            found[str(path.relative_to(bench.folder))] = status.st_mode, digest, changed
    return found


def _is_small(path: Path) -> bool:
    """Return whether it is a file that may be read: a fault may have made it longer than memory."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size < _LARGEST_FILE / 64


def _judge_traces(result: Result, bench: Bench, before: dict[str, Any]) -> None:
    """Add findings if the case left files, wrote outside, opened a connection or printed control characters."""
    if (after := snapshot(bench)) != before:
        changed = sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))
        result.findings.append("outside")
        result.traceback.append(f"changed: {changed}")
    if result.seconds > bench.seconds:
        result.findings.append("hang")
    if result.megabytes > bench.memory / 2**20:
        result.findings.append("memory")
    if select.select([bench.listener], [], [], 0)[0]:
        bench.listener.accept()[0].close()
        result.findings.append("connection")
    temporary = bench.folder / "tmp"
    if left := sorted(path.name for path in temporary.iterdir() if not path.name.startswith("mien-crash-")):
        if not result.findings:
            result.findings.append("leftover")
            result.traceback.append(f"left in the folder for temporary files: {left}")
        shutil.rmtree(temporary)
        temporary.mkdir()
    told = bench.told.read_text(errors="surrogateescape") if bench.told.exists() else ""
    if _CONTROL.search(told.replace("\r", "")):
        result.findings.append("printed")
        result.traceback.append(f"printed: {ascii(told[-300:])}")
    for report in bench.root.rglob("*.html"):
        with contextlib.suppress(OSError):
            if _is_small(report) and SCRIPT in report.read_text(errors="replace"):
                result.findings.append("script")


def faults_of_message(message: str, root: str) -> list[str]:
    """Return what is wrong with a complaint, as it reaches the terminal: several lines, no name, too long."""
    printed = io.StringIO()
    with contextlib.redirect_stderr(printed):
        tell(f"mien: {message}")
    line = printed.getvalue().removesuffix("\n")
    lines = "message" if "\n" in line or _CONTROL.search(line) else ""
    nameless = "nameless" if root not in message else ""
    return [fault for fault in (lines, nameless, "long message" if len(message) > 3000 else "") if fault]


def _add_traceback(result: Result, error: BaseException) -> None:
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{Path(frame.filename).name}:{frame.lineno} {frame.name}: {frame.line or ''}" for frame in frames]
    result.traceback = [place[:160] for place in places[-6:]]
    last = [frame for frame in frames if "/mien/" in frame.filename][-1:] or frames[-1:]
    where = f"{Path(last[0].filename).name}:{last[0].name}"
    if type(error).__name__ == "CommandError":
        logged = re.findall(r'File "[^"]*/mien/([^"]+)", line \d+, in (\w+)', str(error))
        where = f"{Path(logged[-1][0]).name}:{logged[-1][1]}" if logged else result.message[:60]
    result.cause = f"{'+'.join(result.findings)}: {type(error).__name__} in {where}"


def _forget_peak() -> int:
    """Reset the recorded peak of this process's memory, and return what it holds now."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _status(name: str) -> int:
    text = Path("/proc/self/status").read_text()
    return int(re.search(rf"{name}:\s+(\d+)", text)[1]) * 1024  # type: ignore[index]
