"""Run two `mien` processes at the same moment, many times, on a workspace for which all is quick."""

import contextlib
import importlib
import io
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from mien.cli import main
from mien.face import add_face_model
from mien.storage import write_arrays
from toy_scene import toy_capture, toy_face_model, toy_tracking

WORK = {
    "train": ("mien.training.trainer", "_train_to_the_end"),
    "capture": ("mien.capture.from_video", "survey_source"),
    "evaluate": ("mien.evaluation.evaluate", "_evaluate"),
    "analyze": ("mien.lab.analysis.running", "write_page"),
    "import": ("mien.commands.stages.importing", "write_imported_run"),
}
"""Module and function that each command runs while it writes."""
_TIMESTEPS, _SIZE = 5, 48
_PATIENCE_SECONDS = 120


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command."""

    pid: int
    code: int
    told: str
    """Text on standard error."""
    worked: list[tuple[str, float, float]]
    """Calls of `WORK` that were made, with start and end on the system's clock."""


class Pair:
    """Two processes that have imported everything, and start each round together."""

    def __init__(self, cache: Path, without_locks: bool = False) -> None:
        context = multiprocessing.get_context("spawn")
        self._barrier = barrier = context.Barrier(2)  # kept, since it is destroyed with its last reference
        self._ends, self._processes = [], []
        for _ in range(2):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, barrier, cache, without_locks), daemon=True)
            process.start()
            self._ends.append(ours)
            self._processes.append(process)

    def run(self, *commands: list[str], waits: tuple[float, float] = (0, 0)) -> list[Outcome]:
        """Run one command in each process, started together but for these seconds."""
        for end, command, wait in zip(self._ends, commands, waits, strict=True):
            end.send((command, wait))
        assert all(end.poll(_PATIENCE_SECONDS) for end in self._ends), "a command does not end"
        return [end.recv() for end in self._ends]

    def close(self) -> None:
        for end, process in zip(self._ends, self._processes, strict=True):
            with contextlib.suppress(OSError):
                end.send(None)
            process.join(10)
            process.kill()


def _serve(pipe: Connection, barrier: Barrier, cache: Path, without_locks: bool) -> None:
    os.environ |= {"MIEN_CACHE": str(cache), "MIEN_THREADS": "1"}
    torch.set_num_threads(1)
    worked: list[tuple[str, float, float]] = []
    for kind, (module, name) in WORK.items():
        _watch(importlib.import_module(module), name, kind, worked)
    if without_locks:
        for module in ("mien.training.trainer", "mien.capture.from_video", "mien.evaluation.evaluate"):
            importlib.import_module(module).hold = lambda *_, **__: contextlib.nullcontext()  # type: ignore[attr-defined]
    for kind in ("capture", "create", "evaluate", "train", "render", "analyze", "import"):
        importlib.import_module(f"mien.commands.{kind}")
    for stage in ("capturing", "evaluating", "tracking", "training", "pictures"):
        importlib.import_module(f"mien.commands.stages.{stage}")
    while (received := pipe.recv()) is not None:
        command, wait = received
        worked.clear()
        sys.argv = ["mien", *command]
        with contextlib.redirect_stderr(io.StringIO()) as told, contextlib.redirect_stdout(io.StringIO()):
            barrier.wait(_PATIENCE_SECONDS)
            time.sleep(wait)
            code = main(command)
        pipe.send(Outcome(os.getpid(), code, told.getvalue(), list(worked)))


def waits_to_meet(waits: tuple[float, float], outcomes: list[Outcome]) -> tuple[float, float]:
    """Return the waits after which two commands that did not meet would have begun their work at one moment."""
    one, other = (outcome.worked[0][1] if outcome.worked else None for outcome in outcomes)
    if one is not None and other is not None:
        lag = waits[1] - waits[0] + one - other
    elif one is not None or other is not None:  # the late one had nothing left to do
        lag = waits[1] - waits[0] + (0.05 if other is not None else -0.05)
    else:
        return waits
    return (-lag, 0) if lag < 0 else (0, lag)


def _watch(module: Any, name: str, kind: str, worked: list[tuple[str, float, float]]) -> None:
    original = getattr(module, name)

    def watched(*arguments: Any, **named: Any) -> Any:
        began = time.monotonic()
        try:
            return original(*arguments, **named)
        finally:
            worked.append((kind, began, time.monotonic()))

    setattr(module, name, watched)


@contextlib.contextmanager
def pair(cache: Path, without_locks: bool = False) -> Iterator[Pair]:
    """Start two processes with this folder of face models.

    `without_locks` breaks them, to see that the tests notice.
    """
    both = Pair(cache, without_locks)
    try:
        yield both
    finally:
        both.close()


@dataclass(frozen=True)
class Studio:
    """Filmed toy head: a workspace in which it is captured and tracked, and the options of its commands."""

    root: Path
    video: Path
    capture_options: list[str]
    """Options of a capture with mattes and landmarks, so that nothing has to be detected."""
    avatar_folder: Path
    """Place of an exported GaussianAvatars folder."""
    create_options: list[str]
    """Options of `create` with which everything up to the tracking is current and training is short."""


RANK = ["--method.expression-rank", "0", "--method.appearance", "static"]
"""Options without changes with the expression, which GaussianAvatars' own files cannot hold."""


def toy_studio(folder: Path, cache: Path) -> Studio:
    """Film, capture and track the toy head without any detector. MIEN_CACHE has to be `cache`."""
    from mien.commands.stages.tracking import _tracking_fingerprint
    from mien.tracking import Scoring, TrackingSettings, write_scoring, write_tracking
    from mien.workspace import Workspace

    assert os.environ["MIEN_CACHE"] == str(cache)
    model = toy_face_model()
    add_face_model(model, folder / "toy.npz", "none")
    film, alpha = toy_capture(model, _TIMESTEPS, _SIZE)
    (folder / "mattes").mkdir(parents=True)
    (folder / "pictures").mkdir()
    for timestep in range(_TIMESTEPS):
        cv2.imwrite(str(folder / "mattes" / f"{timestep}.png"), alpha[timestep, 0])
        cv2.imwrite(str(folder / "pictures" / f"{timestep}.png"), film.images[timestep, 0][..., ::-1])
    marks = np.random.default_rng(0).uniform(8, 40, (_TIMESTEPS, 478, 2)).astype(np.float32)
    write_arrays(folder / "landmarks.safetensors", {"landmarks": marks})
    capture_options = ["--capture.crop", "none", "--capture.mattes", str(folder / "mattes")]
    capture_options += ["--capture.landmarks", str(folder / "landmarks.safetensors")]
    root, video = folder / "workspace", folder / "pictures"
    assert main(["capture", str(video), "--out", str(root), "--name", "clip", *capture_options]) == 0
    workspace, sequence = Workspace(root), root / "sequences" / "clip"
    fingerprint = _tracking_fingerprint(workspace, ["clip"], model, TrackingSettings())
    made_from = {"fingerprint": fingerprint, "tracked_together": ["clip"]}
    write_tracking(sequence / "tracking", replace(toy_tracking(model, _TIMESTEPS, _SIZE), settings=made_from))
    (sequence / "tracking" / "report.html").write_text("a report")
    crops = np.tile(np.array([4, 4, 30, 30], np.int64), (_TIMESTEPS, 1, 1))
    from mien.capture import read_capture_hash

    write_scoring(sequence / "scoring", Scoring(alpha, crops), read_capture_hash(sequence / "capture"))
    create_options = ["--name", "clip", "--face-model", "toy", "--overlay", "none", "--steps", "3", "--split", "tail"]
    create_options += RANK
    return Studio(root, video, capture_options, folder / "avatar", [*create_options, *capture_options])
