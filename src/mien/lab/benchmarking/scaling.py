"""Measure how drawing and training scale with Gaussians, size, pictures and threads (`mien bench scaling`)."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mien import _native
from mien.face.loading import load_face_model
from mien.lab.benchmarking import train_step
from mien.lab.benchmarking.render import PAPER_SIZES, drawing_rows, head_scene
from mien.lab.benchmarking.step_parts import COUNT, SIZE, default_case
from mien.lab.benchmarking.timing import BenchmarkRow, benchmark_row, thread_counts, time_function
from mien.machine.terminal import counted
from mien.pages.pages import Axes, Series, write_chart
from mien.render.rasterize import View, rasterize_each
from mien.training.apart import threads_of_frames
from mien.training.trainer import step

COUNTS = (10_000, 30_000, 100_000, 300_000)
SIZES = (*PAPER_SIZES.values(), (1024, 1024), (2048, 2048))
PICTURES = (1, 2, 4, 8)
"""Numbers of pictures that are drawn at once."""
STYLES = ("main", "second", "third", "fourth")


def scaling_suite(seconds: float = 0.8) -> Iterator[BenchmarkRow]:
    """Measure 10,000 to 300,000 Gaussians at the papers' sizes and up to 2048x2048, with one thread and with all.

    Then 1 to 8 pictures at once, and a training step of the default, by 1, 2, 4 and more threads up to all.
    """
    for size in SIZES:
        for count in COUNTS:
            yield from drawing_rows(count, size, seconds)
    scene = head_scene(COUNT, *SIZE)
    for pictures in PICTURES:
        views: list[View] = [(scene.gaussians, scene.camera)] * pictures
        yield from _by_threads(f"rasterize_{pictures}_at_once", lambda v=views: _draw(v, scene.background), seconds)
    state, data, settings = default_case(load_face_model())
    for _ in _numbers_of_threads():
        with threads_of_frames(train_step.ON_CPU) as each:
            own = replace(data, each=each)
            timing = time_function(lambda own=own: step(state, own, settings), 4 * seconds)
        yield benchmark_row("train_step_default", COUNT, SIZE, timing)


@torch.no_grad()
def _draw(views: Sequence[View], background: Tensor) -> None:
    rasterize_each(views, [background] * len(views))


def _by_threads(name: str, function: Callable[[], object], seconds: float) -> Iterator[BenchmarkRow]:
    for _ in _numbers_of_threads():
        yield benchmark_row(name, COUNT, SIZE, time_function(function, seconds))


def _numbers_of_threads() -> Iterator[None]:
    """Set the number of native threads to 1, 2, 4 and more, up to all."""
    *_, most = thread_counts()
    for threads in sorted({*(1 << power for power in range(most.bit_length())), most}):
        _native.set_thread_count(threads)
        yield


def shares_that_do_not_scale(rows: Sequence[BenchmarkRow]) -> Iterator[str]:
    """Yield a line for each work that several numbers of threads did: the share of its time that they do not shorten.

    The share is s in Amdahl's law, T(n) = T(1) (s + (1 - s) / n), from one thread and all.
    """
    works: dict[tuple[str, int, int, int], dict[int, float]] = defaultdict(dict)
    for row in rows:
        works[row.name, row.gaussians, row.width, row.height][row.threads] = row.min_ms
    for (name, gaussians, width, height), ms in works.items():
        if (most := max(ms)) > 1 and 1 in ms:
            share = min(max((ms[most] / ms[1] - 1 / most) / (1 - 1 / most), 0.0), 1.0)
            yield (
                f"{name:28} {gaussians:7} {width:5}x{height:<5} {100 * share:3.0f} % does not scale "
                f"({ms[1] / ms[most]:.2f} times as fast with {most} threads)"
            )


def write_scaling_chart(path: Path, rows: Sequence[BenchmarkRow]) -> None:
    """Write a .svg of milliseconds: over Gaussians, a line per size; over threads, a line per number of pictures."""
    charts = []
    over_threads = [row for row in rows if not row.name.endswith(("_forward", "_backward"))]
    for name, threads in dict.fromkeys((row.name, row.threads) for row in rows if row not in over_threads):
        own = [row for row in rows if (row.name, row.threads) == (name, threads)]
        lines = [
            _line(f"{width}x{height}", [row for row in own if (row.width, row.height) == (width, height)], "gaussians")
            for width, height in dict.fromkeys((row.width, row.height) for row in own)
        ]
        title = f"{name.replace('_', ' ')}, {counted(threads, 'thread')}: milliseconds, least"
        charts.append((title, _styled(lines), _axes("Gaussians")))
    for names in (["train_step_default"], [f"rasterize_{pictures}_at_once" for pictures in PICTURES]):
        lines = [
            _line(name.replace("_", " "), [row for row in over_threads if row.name == name], "threads")
            for name in names
        ]
        charts.append((f"{COUNT:,} Gaussians by threads: milliseconds, least", _styled(lines), _axes("threads")))
    write_chart(path, charts)


def _line(label: str, rows: Sequence[BenchmarkRow], over: str) -> Series:
    return Series(label, np.array([getattr(row, over) for row in rows], np.float64), np.array([r.min_ms for r in rows]))


def _styled(lines: Sequence[Series]) -> list[Series]:
    return [Series(line.label, line.x, line.y, style) for line, style in zip(lines, STYLES, strict=False)]


def _axes(label: str) -> Axes:
    return Axes(label, "milliseconds, least", 640, 320, logarithmic=True)
