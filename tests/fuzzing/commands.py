"""Captures, drivers and batches of faulty inputs: what they leave is whole, and what is unfinished is hidden."""

import itertools
from pathlib import Path
from random import Random

import numpy as np
import safetensors.numpy

from fuzzing.uses import SEEN, run_line, use_capture
from mien.batch.paper import write_table
from mien.batch.plan import Batch
from mien.batch.results import write_results
from mien.capture import read_capture
from mien.capture.from_video import capture_video_parts
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from mien.media.source import FrameSelection, FrameSource, open_source


def read_film(root: Path, file: Path) -> FrameSource:
    """Read every stream of a film, or a folder of pictures, as a capture does."""
    source = open_source(file, FrameSelection(), 25.0)
    for stream in (source.stream, *source.video.other_streams[:2]):
        source = open_source(file, FrameSelection(), 25.0, stream=stream)
        for frame in itertools.islice(source.frames(48), 3 * SEEN):
            picture, alpha, (width, height) = frame.picture(), frame.alpha(), frame.size()
            assert (picture.dtype, picture.ndim) == (np.uint8, 3)
            assert alpha is None or (alpha.dtype, alpha.shape) == (np.uint8, (height, width)), (alpha.shape, height)
            assert np.isfinite((frame.seconds, frame.combs())).all()
    return source


def _landmarks(root: Path, frames: int) -> Path:
    points = np.random.default_rng(0).uniform(5, 25, (frames, 478, 2)).astype(np.float32)
    safetensors.numpy.save_file({"landmarks": points}, root / "film.safetensors")
    return root / "film.safetensors"


def capture_film(root: Path, found: FrameSource, dice: Random) -> None:
    """Capture a film with landmarks as given, without networks. A refused one leaves hidden files alone, to go on."""
    mattes, landmarks = found.path if dice.random() < 0.7 else None, _landmarks(root, min(found.count(), 1000))
    given = {"landmarks": landmarks, "mattes": mattes, "stream": found.stream, "detector": "litert"}
    try:
        captures = capture_video_parts(found.path, root / "S", CaptureSettings(32, "none", shortest_part=0.0, **given))
    except UserError:
        left = [path.relative_to(root) for path in root.glob("S/**/*") if path.is_file()]
        assert all(any(name.startswith(".") for name in path.parts) for path in left), left
        raise
    for capture in captures:
        use_capture(root, capture, Random(0))
    assert not [path.name for path in (root / "S").rglob(".*")], "leftovers"


def drive_by_pictures(root: Path, found: None, dice: Random) -> None:
    """Drive by a folder of pictures, with landmarks as given, up to the tracking. What was captured is kept whole."""
    pictures = sum(path.is_file() and not path.name.startswith(".") for path in root.glob("alphas/*"))
    _landmarks(root, pictures if pictures > 2 else 3 * pictures)
    options = "--capture.landmarks {root}/film.safetensors --capture.size 32 --capture.crop none"
    try:
        run_line("drive {W} --by {root}/alphas --out {root}/o.mp4 --size 16 " + options, root)
    finally:
        assert not list(root.glob("*o.*")), "a film"
        for folder in (root / "cache/drivers").glob("*/sequences/[!.]*/capture"):
            read_capture(folder)


def read_batch(root: Path, file: Path) -> None:
    run_line("batch status {root}/batch", root)
    run_line("batch status {root}/batch --json", root)


def run_batch(root: Path, found: object, dice: Random) -> None:
    """Run the table of a batch with a program that fails, and compare its results. Its states are whole."""
    table, out = next(root.glob("tables/people*")), root / "batch"
    if dice.random() < 0.2:
        try:
            run_line(f"batch {table} --out {out} --retry 0 --jobs 1 --program false", root)
        finally:
            for row in Batch(out).read_plan() if out.exists() else ():
                assert getattr(Batch(out).read_state(row.name), "status", "") in ("failed", "done")
    if out.exists():
        write_table(Batch(out), write_results(Batch(out)), None)
