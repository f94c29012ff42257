"""How fast the native rasterizer draws a synthetic head that fills half of the picture.

Run as `mien bench render [--json]`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from mien import _native
from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render import rasterize


@dataclass(frozen=True)
class BenchmarkRow:
    """One timing; milliseconds of wall-clock time."""

    name: str
    gaussians: int
    width: int
    height: int
    threads: int
    isa: str
    min_ms: float
    median_ms: float


def synthetic_head(count: int, coefficients: int = 1) -> Gaussians:
    """An ellipsoid's surface in small, mostly opaque splats whose total area does not depend on their number."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    spread = torch.exp(0.35 * torch.randn(count, 3, generator=generator))
    return Gaussians(
        means=directions * torch.tensor([0.085, 0.11, 0.095]),
        quats=torch.randn(count, 4, generator=generator),
        scales=spread * 0.00056 * (30000 / count) ** 0.5,
        opacities=torch.sigmoid(2 + 1.5 * torch.randn(count, generator=generator)),
        sh=0.3 * torch.randn(count, coefficients, 3, generator=generator),
    )


def benchmark_render(count: int, size: int, threads: int, repetitions: int = 40) -> list[BenchmarkRow]:
    """Forward alone, and forward with backward, of one square picture. Changes the number of native threads."""
    _native.set_thread_count(threads)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 0.6
    focal = 2.35 * size
    camera = Camera(torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), viewmat, size, size)
    background = torch.ones(3)
    head = synthetic_head(count)
    parameters = [t.requires_grad_() for t in (head.means, head.quats, head.scales, head.opacities, head.sh)]
    gradient = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(1))

    def forward() -> None:
        with torch.no_grad():
            rasterize(head, camera, background, "native")

    def both() -> None:
        torch.autograd.grad(rasterize(head, camera, background, "native").image, parameters, gradient)

    rows = []
    for name, function in (("rasterize_forward", forward), ("rasterize_forward_backward", both)):
        fastest, median = _time(function, repetitions)
        rows.append(BenchmarkRow(name, count, size, size, threads, _native.rasterize_isa(), fastest, median))
    return rows


def _time(function: Callable[[], None], repetitions: int) -> tuple[float, float]:
    """The least and the median duration in milliseconds, after a warm-up."""
    for _ in range(3):
        function()
    durations = []
    for _ in range(repetitions):
        start = time.perf_counter()
        function()
        durations.append(1e3 * (time.perf_counter() - start))
    durations.sort()
    return durations[0], durations[len(durations) // 2]


def benchmark_suite() -> list[BenchmarkRow]:
    """The rows of docs/results.md: three counts, two sizes, one thread and all of them."""
    torch.set_num_threads(1)
    threads = _native.thread_count()
    rows: list[BenchmarkRow] = []
    for count in (10_000, 30_000, 100_000):
        for size in (512, 1024):
            for used in sorted({1, threads}):
                rows += benchmark_render(count, size, used)
    return rows


def format_row(row: BenchmarkRow) -> str:
    """One line of the table."""
    return (
        f"{row.name:28} {row.gaussians:7} {row.width:5}x{row.height:<5} {row.threads:2} threads {row.isa:8} "
        f"{row.min_ms:8.2f} min {row.median_ms:8.2f} median ms"
    )
