"""Measure how fast the native rasterizer renders a synthetic head that fills half of the picture.

Run as `mien bench render` (two sizes, every instruction set) and `mien bench scaling` (sizes of the papers).
"""

from collections.abc import Iterator

import torch

from mien import _native
from mien.lab.benchmarking.scenes import Scene, head_scene
from mien.lab.benchmarking.timing import BenchmarkRow, benchmark_row, time_function
from mien.render import rasterize
from mien.render.rasterize import Backend

COUNTS = (10_000, 30_000, 100_000, 300_000)
SIZES = {
    "HeadGaS's figure": (512, 512),
    "GaussianAvatars' table": (550, 802),
    "": (1024, 1024),
    "large": (2048, 2048),
}
"""Width and height in pixels (the papers' 802x550 is height x width), by where that size is reported."""
INSTRUCTION_SETS = ("avx512", "avx2", "sse4", "baseline")


def draw(scene: Scene, backend: Backend = "native") -> None:
    """Render one picture without gradients."""
    with torch.no_grad():
        rasterize(scene.gaussians, scene.camera, scene.background, backend)


def draw_and_differentiate(scene: Scene, backend: Backend = "native") -> None:
    """Render one picture and compute the gradients of all parameters."""
    picture = rasterize(scene.gaussians, scene.camera, scene.background, backend).image
    torch.autograd.grad(picture, scene.parameters, scene.gradient)


def benchmark_render(count: int, size: tuple[int, int], threads: int, seconds: float = 0.8) -> list[BenchmarkRow]:
    """Measure forward alone, and forward with backward, of one picture. This changes the number of native threads."""
    _native.set_thread_count(threads)
    scene = head_scene(count, *size)
    forward = time_function(lambda: draw(scene), seconds)
    both = time_function(lambda: draw_and_differentiate(scene), seconds)
    return [
        benchmark_row("rasterize_forward", count, size, forward),
        benchmark_row("rasterize_forward_backward", count, size, both),
    ]


def render_suite(seconds: float = 0.8) -> Iterator[BenchmarkRow]:
    """Measure 10,000 to 100,000 Gaussians at two sizes by threads, then 30,000 at 512x512 by instruction set."""
    for count in COUNTS[:3]:
        for size in ((512, 512), (1024, 1024)):
            for threads in thread_counts():
                yield from benchmark_render(count, size, threads, seconds)
    best = _native.rasterize_isa()
    try:
        for isa in INSTRUCTION_SETS:
            if _native.set_rasterize_isa(isa):
                yield from benchmark_render(30_000, (512, 512), 1, seconds)
    finally:
        _native.set_rasterize_isa(best)


def scaling_suite(seconds: float = 0.8) -> Iterator[BenchmarkRow]:
    """Measure 10,000 to 300,000 Gaussians at the papers' sizes and up to 2048x2048, by threads."""
    for size in SIZES.values():
        for count in COUNTS:
            for threads in thread_counts():
                yield from benchmark_render(count, size, threads, seconds)


def thread_counts() -> list[int]:
    """Return one thread, and all threads that `MIEN_THREADS` or the machine allows."""
    _native.set_thread_count(0)
    return sorted({1, _native.thread_count()})
