"""Timing of benchmarks, and a description of the machine."""

import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from mien import _native
from mien.machine.system import load_average
from mien.machine.threads import one_torch_thread


@dataclass(frozen=True)
class Timing:
    """Times of one function, in milliseconds."""

    min_ms: float
    """Smallest wall-clock time."""
    median_ms: float
    """Median wall-clock time."""
    cpu_ms: float
    """Smallest processor time, summed over threads. Other work on the machine disturbs it least."""


@dataclass(frozen=True)
class BenchmarkRow(Timing):
    """One row of a table."""

    name: str
    gaussians: int
    width: int
    height: int
    threads: int
    isa: str
    """Instruction set of the native kernels; `cuda` on a GPU, where `threads` is 0."""


@dataclass(frozen=True)
class Machine:
    """The machine on which figures were measured."""

    processor: str
    cores: int
    isa: str
    """The best instruction set of the native kernels on this machine."""
    gflops: float
    """Measured float32 operations of one thread in 1e9 per second: a 512x512 matrix product in torch."""
    load: float
    """Load average of the minute before the benchmark. Above 0, other work was running. Always 0 on Windows."""
    gpu: str = ""
    """Name of the GPU, torch's CUDA version and gsplat's version, if the GPU is measured."""


def time_function(
    function: Callable[[], object], seconds: float = 0.8, min_runs: int = 7, like: Tensor | None = None
) -> Timing:
    """Time a function for about `seconds` and at least `min_runs` runs, after two warm-up runs.

    If `like` is on a GPU, a run ends when the GPU has finished it.
    """

    def run() -> None:
        function()
        if like is not None and like.is_cuda:
            torch.cuda.synchronize(like.device)

    for _ in range(2):
        run()
    walls: list[float] = []
    processors: list[float] = []
    end = time.perf_counter() + seconds
    while len(walls) < min_runs or time.perf_counter() < end:
        processor, wall = time.process_time(), time.perf_counter()
        run()
        walls.append(1e3 * (time.perf_counter() - wall))
        processors.append(1e3 * (time.process_time() - processor))
    return Timing(min(walls), sorted(walls)[len(walls) // 2], min(processors))


def benchmark_row(
    name: str, gaussians: int, size: tuple[int, int], timing: Timing, like: Tensor | None = None
) -> BenchmarkRow:
    """A row on the device of `like` (None for the CPU), with the threads in use; `size` is (width, height)."""
    on_gpu = like is not None and like.is_cuda
    threads, isa = (0, "cuda") if on_gpu else (_native.thread_count(), _native.rasterize_isa())
    return BenchmarkRow(
        **asdict(timing), name=name, gaussians=gaussians, width=size[0], height=size[1], threads=threads, isa=isa
    )


def thread_counts() -> list[int]:
    """Return one thread, and all threads that `MIEN_THREADS` or the machine allows."""
    _native.set_thread_count(0)
    return sorted({1, _native.thread_count()})


def rows_by_threads(
    name: str, gaussians: int, size: tuple[int, int], function: Callable[[], object], seconds: float
) -> Iterator[BenchmarkRow]:
    """Time a function with one thread and with all. This changes the number of native threads."""
    for threads in thread_counts():
        _native.set_thread_count(threads)
        yield benchmark_row(name, gaussians, size, time_function(function, seconds))


def measure_machine(gpu: bool = False) -> Machine:
    """Describe this machine. This takes a fifth of a second."""
    load = load_average()
    matrix = torch.randn(512, 512)
    with one_torch_thread():
        timing = time_function(lambda: matrix @ matrix, seconds=0.2)
    gflops = 2 * 512**3 / timing.cpu_ms / 1e6
    isa = _native.rasterize_isa()
    return Machine(_processor(), os.cpu_count() or 1, isa, round(gflops, 1), round(load, 2), _gpu() if gpu else "")


def format_machine(machine: Machine) -> str:
    """Return the machine's description in one line."""
    processor = (
        f"{machine.processor}, {machine.cores} cores, {machine.isa}, {machine.gflops:.0f} GFLOP/s per thread "
        f"(matrix product), load {machine.load:.1f}"
    )
    return f"{machine.gpu}; {processor}" if machine.gpu else processor


def format_row(row: BenchmarkRow) -> str:
    """Return one line of the table."""
    return (
        f"{row.name:28} {row.gaussians:7} {row.width:5}x{row.height:<5} {row.threads:2} threads {row.isa:8} "
        f"{row.min_ms:8.2f} min {row.median_ms:8.2f} median {row.cpu_ms:8.2f} processor ms"
    )


def _gpu() -> str:
    return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}, gsplat {version('gsplat')}"


def _processor() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
