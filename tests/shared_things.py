"""Things that several files of tests read. A run makes each once, by the fixture `made_once` (tests/conftest.py).
Folders are for reading: a test that changes one copies it first."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import train_toy
from mien.batch import drive
from mien.batch.plan import Batch, Row, State
from mien.batch.row import do_steps, run_row
from mien.capture import write_capture
from mien.capture.capture import Capture
from mien.capture.store import read_capture_hash
from mien.cli import main
from mien.evaluation import evaluate
from mien.evaluation.protocols import EvaluationSettings
from mien.tracking import write_tracking
from mien.tracking.scoring import Scoring
from mien.tracking.scoring_files import write_scoring
from mien.tracking.tracking import Tracking
from mien.training import read_sequence, train
from toy_scene import toy_sequence

MadeOnce = Callable[[str, Callable[[Path], object]], Path]


def write_sequence(folder: Path, capture: Capture, tracking: Tracking, masks: np.ndarray | None = None) -> None:
    """Write a sequence's folders. Without `masks`, the capture's mattes are the scoring masks."""
    write_capture(folder / "capture", capture)
    write_tracking(folder / "tracking", tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (capture.timesteps, 1, 1))
    scoring = Scoring(capture.mattes if masks is None else masks, crops)
    write_scoring(folder / "scoring", scoring, read_capture_hash(folder / "capture"))


def write_toy_workspace(root: Path, timesteps: int = 5) -> None:
    """Write `root/sequences/clip` and `root/runs/toy` as `mien create` leaves them. The last fifth is held out."""
    face_model, sequence = toy_sequence(timesteps, 32)
    folder = root / "sequences" / "clip"
    write_sequence(folder, sequence.capture, sequence.tracking, sequence.scoring)
    settings = replace(train_toy.SETTINGS, split="tail")
    train([read_sequence(folder)], face_model, train_toy.CONFIG, settings, root / "runs" / "toy")


def write_evaluated_workspace(root: Path) -> Path:
    write_toy_workspace(root)
    evaluate(root / "runs/toy", [root / "sequences/clip"], EvaluationSettings(perceptual=False, video_frames=0))
    return root


def toy_workspace(made_once: MadeOnce) -> Path:
    """Return a workspace with the sequence `clip` of five frames and the trained run `toy`."""
    return made_once("toy_workspace", write_toy_workspace)


def evaluated_workspace(made_once: MadeOnce) -> Path:
    """Return the same with the figures of its run."""
    return made_once("evaluated_workspace", write_evaluated_workspace)


def rows_here(monkeypatch: pytest.MonkeyPatch, run: Callable[[list[str]], int] = main) -> list[list[str]]:
    """Let the rows of `mien batch` run in this process, and return the list of their commands, which grows."""
    seen: list[list[str]] = []

    def attempt(root: Path, program: object, threads: object, row: Row) -> State | None:
        return run_row(Batch(root), row, partial(do_steps, lambda words: seen.append(words) or run(words)))

    monkeypatch.setattr(drive, "attempt", attempt)
    return seen
