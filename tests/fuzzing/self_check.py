"""Check that the fuzzers can fail: they find readers that are wrong in every way, and repairs work.

If a repair stopped working, checksums would catch every fault, and nothing behind them would be tested.
"""

import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import safetensors.numpy

from fuzzing import uses
from fuzzing.edges import SCRIPT
from fuzzing.faults import Place
from fuzzing.material import copy_of
from fuzzing.repairs import repair_around, repair_portable, repair_tensors, with_checksum
from fuzzing.targets import TARGETS, Target
from fuzzing.tensor_faults import joined, split
from fuzzing.workers import run_cases
from mien import cli
from mien.errors import UserError

_LIMITS = {"seconds": 1.5, "memory": 64 << 20}


def failures(folder: Path, material: Path) -> Iterator[str]:
    """Yield a line for everything that the fuzzers would miss. None is yielded if all is well."""
    for expected, read in _WRONG.items():
        name = f"wrong: {expected}"
        TARGETS[name] = Target(name, "self", "head.ply", ("head.ply",), read, fault=_no_fault)
        try:
            (result,) = run_cases([f"{name}:0:0"], folder / "wrong", material, **_LIMITS)
        finally:
            del TARGETS[name]
        if expected not in result.findings:
            yield f"a reader that is wrong by {expected} is judged {result.outcome} {result.findings} {result.message}"
    for name, edit in _EDITS.items():
        root = folder / "repaired"
        shutil.rmtree(root, ignore_errors=True)
        target = TARGETS[name]
        copy_of(material, target.parts, root)
        file = next(iter(sorted(root.glob(target.files))))
        before = file.read_bytes()
        edit(file)
        repair_around(file)
        try:
            assert file.read_bytes() != before, "nothing was edited"
            found = target.read(root, file)
            if target.use in (uses.use_run, uses.use_evaluation):
                uses.use_evaluation(root, found, Random(0))
        except (UserError, AssertionError) as error:
            yield f"{name} with a sane edit and everything made right around it: {error}"


def _no_fault(place: Place, dice: Random) -> str:
    (place.root / "port").write_text(str(place.port))
    return "none"


def _raise(error: Exception) -> Callable[[Path, Path], Any]:
    def read(root: Path, file: Path) -> Any:
        raise error

    return read


def _complain_as_it_comes(file: Path) -> None:
    """Print a message without making control characters harmless. It runs in a child, so nobody else sees it."""
    cli._complain = lambda message: print(message, file=sys.stderr) or 2  # type: ignore[func-returns-value]
    raise UserError(f"{file}: two\nlines")


def _call(root: Path, file: Path) -> None:
    with socket.socket() as caller:
        caller.connect(("127.0.0.1", int((root / "port").read_text())))


def _report(root: Path, file: Path) -> None:
    (root / "report.html").write_text(f"<p>{SCRIPT}</p>")


_WRONG: dict[str, Callable[[Path, Path], Any]] = {
    "signal": lambda root, file: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda root, file: time.sleep(60),
    "memory": lambda root, file: np.ones(100 << 20, np.uint8).sum(),
    "traceback": _raise(KeyError("x")),
    "message": lambda root, file: _complain_as_it_comes(file),
    "nameless": _raise(UserError("a file: cannot be read")),
    "outside": lambda root, file: (root.parent / "outside/victim").write_bytes(b"gone"),
    "leftover": lambda root, file: tempfile.mkdtemp(),
    "connection": _call,
    "printed": lambda root, file: print("\x1b[2J", file=sys.stderr, flush=True),
    "script": _report,
}
"""Faulty readers, by the finding that they must cause."""


def _edit_json(*path: Any, value: Any) -> Callable[[Path], None]:
    def edit(file: Path) -> None:
        content = json.loads(file.read_text())
        inner = content
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        file.write_text(json.dumps(with_checksum(content)))

    return edit


def _edit_numbers(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def edit(file: Path) -> None:
        data = file.read_bytes()
        arrays = safetensors.numpy.load(data)
        header, body = split(safetensors.numpy.save({**arrays, name: change(arrays[name])}))
        metadata = split(data)[0].get("__metadata__")
        whole = joined({"__metadata__": metadata, **header} if metadata else header, body)
        file.write_bytes(repair_portable(whole) if file.suffix == ".mien" else repair_tensors(whole))

    return edit


def _bit_more(array: np.ndarray) -> np.ndarray:
    return array + np.array(1e-4, array.dtype)


_EDITS: dict[str, Callable[[Path], None]] = {
    "capture.json": _edit_json("fps", value=24.5),
    "landmarks.safetensors": _edit_numbers("landmarks", _bit_more),
    "tracking.json": _edit_json("settings", value={"edited": 1}),
    "tracking.safetensors": _edit_numbers("expression", _bit_more),
    "scoring.json": _edit_json("edited", value=1),
    "crops.safetensors": _edit_numbers("crops", lambda array: array + 1),
    "config.json": _edit_json("mien", value="0.0"),
    "analysis.json": _edit_json("mien", value="0.0"),
    "folder's face model": _edit_json("name", value="edited"),
    "metrics.json": _edit_json("training", "seconds", value=1.5),
    "curves.safetensors": _edit_numbers("loss", _bit_more),
    "face_track.safetensors": _edit_numbers("expression", _bit_more),
    "avatar.safetensors": _edit_numbers("avatar.store.trained.opacity_logits", _bit_more),
    "avatar's face_model.safetensors": _edit_numbers("expression_basis", _bit_more),
    "head.mien": _edit_numbers("baked.attributes.opacity_logits", _bit_more),
}
"""Edits that readers must accept once everything around them is repaired."""
