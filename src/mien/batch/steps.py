"""The steps of a row as commands of mien, the seconds of their stages, and the figures and thumbnails of their runs."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from mien.batch.plan import WORKSPACE, Batch, Row
from mien.batch.row import RowFailedError, last_error
from mien.batch.store import fetched
from mien.disk.files import write_atomically
from mien.disk.workspace import Workspace
from mien.machine.progress import current_stage

Main = Callable[[list[str]], int]
"""Runs a command of mien and returns its exit code."""
_VIEWS, _SIDE = 12, 160
"""Number of pictures in a thumbnail, and their sides in pixels."""


def do_steps(main: Main, batch: Batch, row: Row) -> tuple[tuple[dict[str, Any], ...], dict[str, float]]:
    """Run the steps of a row with `main`, as `mien.batch.row.Do` does."""
    workspace = batch.workspace(row.name)
    stages: defaultdict[str, float] = defaultdict(float)
    for step in row.steps:
        words = [fetched(word.replace(WORKSPACE, str(workspace)), batch.place("inputs")) for word in step]
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
        found |= {key: content["training"].get(key) for key in ("gaussians", "steps", "seconds")}
        found["training_seconds"] = found.pop("seconds")
    if (run_dir / "film.mp4").is_file():
        thumbnail = batch.place("thumbs", f"{name}.{run_dir.name}.jpg")
        write_atomically(thumbnail, partial(write_strip, run_dir / "film.mp4"))
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
