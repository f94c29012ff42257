"""Measure how fast a synthetic head that fills half of the picture is rendered (`mien bench render`)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.lab.benchmarking.timing import BenchmarkRow, benchmark_row, rows_by_threads, time_function
from mien.render import rasterize

COUNTS = (10_000, 30_000, 100_000)
PAPER_SIZES = {"HeadGaS's figure": (512, 512), "GaussianAvatars' table": (550, 802)}
"""Width and height in pixels (the papers' 802x550 is height x width), by where that size is reported."""
GPU_COUNTS = (30_000, 100_000)


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians whose tensors are leaves, a camera, and a gradient of the picture for backward passes."""

    gaussians: Gaussians
    camera: Camera
    background: Float[Tensor, " 3"]
    gradient: Float[Tensor, "h w 3"]

    @property
    def parameters(self) -> list[Tensor]:
        """The tensors whose gradients are computed."""
        own = self.gaussians
        return [own.means, own.quats, own.scales, own.opacities, own.sh]

    def draw(self) -> None:
        """Render one picture without gradients."""
        with torch.no_grad():
            rasterize(self.gaussians, self.camera, self.background)

    def draw_and_differentiate(self) -> None:
        """Render one picture and compute the gradients of all parameters."""
        picture = rasterize(self.gaussians, self.camera, self.background).image
        torch.autograd.grad(picture, self.parameters, self.gradient)


def synthetic_head(count: int, coefficients: int = 1) -> Gaussians:
    """Cover an ellipsoid with small, mostly opaque splats. Their total area does not depend on their number."""
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


def head_camera(width: int, height: int) -> Camera:
    """Return a camera 60 cm in front of the head, whose height is three quarters of the picture's shorter side."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 0.6
    focal = 2.35 * min(width, height)
    return Camera(torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), viewmat, width, height)


def head_scene(count: int, width: int, height: int, like: Tensor | None = None) -> Scene:
    """Return the head over white, with the float dtype and the device of `like` (None: float32 on the CPU)."""
    head, like = synthetic_head(count), torch.zeros(()) if like is None else like
    names = ("means", "quats", "scales", "opacities", "sh")
    head = replace(head, **{name: getattr(head, name).to(like).requires_grad_() for name in names})
    gradient = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(1))
    return Scene(head, head_camera(width, height).to(like), like.new_ones(3), gradient.to(like))


def drawing_rows(count: int, size: tuple[int, int], seconds: float) -> Iterator[BenchmarkRow]:
    """Measure forward alone, and forward with backward, of one picture, by threads."""
    scene = head_scene(count, *size)
    yield from rows_by_threads("rasterize_forward", count, size, scene.draw, seconds)
    yield from rows_by_threads("rasterize_forward_backward", count, size, scene.draw_and_differentiate, seconds)


def render_suite(seconds: float = 0.8) -> Iterator[BenchmarkRow]:
    """Measure 10,000 to 100,000 Gaussians at two sizes by threads, then 30,000 at 512x512 by instruction set."""
    for count in COUNTS:
        for size in ((512, 512), (1024, 1024)):
            yield from drawing_rows(count, size, seconds)
    best, scene = _native.rasterize_isa(), head_scene(30_000, 512, 512)
    _native.set_thread_count(1)
    try:
        for isa in ("avx512", "avx2", "sse4", "baseline"):
            if _native.set_rasterize_isa(isa):
                for name, work in (("forward", scene.draw), ("forward_backward", scene.draw_and_differentiate)):
                    yield benchmark_row(f"rasterize_{name}", 30_000, (512, 512), time_function(work, seconds))
    finally:
        _native.set_rasterize_isa(best)


def gpu_rows(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """Measure the same on the device of `like`, at the papers' sizes."""
    for count in GPU_COUNTS:
        for size in PAPER_SIZES.values():
            scene = head_scene(count, *size, like)
            for name, work in (("forward", scene.draw), ("forward_backward", scene.draw_and_differentiate)):
                timing = time_function(work, seconds, like=like)
                yield benchmark_row(f"rasterize_{name}", count, size, timing, like)
