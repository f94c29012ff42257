"""Measure mien's native core and its peers in turn, forward and backward, on the same scenes in one run.

    python benchmarks/peers/compare.py --counts 10000 30000 --rounds 3

README.md beside this file lists the peers.
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Annotated

import torch
import tyro
from torch import Tensor
from torch_tiles import render_tiles

from mien import _native
from mien.lab.benchmarking.render import Scene, head_scene
from mien.lab.benchmarking.timing import Timing, benchmark_row, format_machine, format_row, measure_machine
from mien.render import rasterize

Draw = Callable[[Scene], Tensor]
"""Function from a scene to its picture [h, w, 3], differentiable in the scene's parameters."""


@dataclass(frozen=True)
class Comparison:
    """Measure mien's native core and its peers, forward and backward, in turn."""

    counts: tuple[int, ...] = (10_000, 30_000)
    """Numbers of Gaussians."""
    size: int = 512
    """Side of the picture in pixels."""
    rounds: int = 3
    """Number of rounds. In each round every peer runs once, and the native core, which is quick, ten times."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the machine and a list of rows for programs."""


def find_peers() -> dict[str, Draw]:
    """Return the peers that can run on this machine, the native core first."""
    peers: dict[str, Draw] = {"mien_native": lambda s: rasterize(s.gaussians, s.camera, s.background, "native").image}
    if torch.cuda.is_available():
        peers["gsplat"] = _draw_on_gpu
    peers["torch_tiles"] = lambda s: render_tiles(s.gaussians, s.camera, s.background)
    return peers


def measure(scene: Scene, rounds: int) -> dict[str, Timing]:
    """Measure forward and backward of every peer, in turn."""
    walls: dict[str, list[float]] = {}
    processors: dict[str, list[float]] = {}
    expected: Tensor | None = None
    for turn in range(rounds + 1):
        for name, draw in find_peers().items():
            for _ in range(10 if name == "mien_native" else 1):
                processor, wall = time.process_time(), time.perf_counter()
                picture = draw(scene)
                torch.autograd.grad(picture, scene.parameters, scene.gradient.to(picture))
                took = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - processor)
                if turn > 0:  # the first round warms up
                    walls.setdefault(name, []).append(took[0])
                    processors.setdefault(name, []).append(took[1])
            picture = picture.detach().cpu()  # pyright: ignore[reportPossiblyUnboundVariable]
            expected = picture if expected is None else expected
            difference = float((picture - expected).abs().mean())
            assert difference < 2e-3, f"{name} draws another picture: mean difference {difference}"
    return {name: Timing(min(own), sorted(own)[len(own) // 2], min(processors[name])) for name, own in walls.items()}


def _draw_on_gpu(scene: Scene) -> Tensor:
    like = torch.zeros((), device="cuda")
    on_gpu = replace(scene.camera, K=scene.camera.K.to(like), viewmat=scene.camera.viewmat.to(like))
    picture = rasterize(scene.gaussians.to(like), on_gpu, scene.background.to(like), "gsplat").image
    torch.cuda.synchronize()
    return picture


def main(comparison: Comparison) -> None:
    """Print one row for each peer and number of Gaussians."""
    torch.set_num_threads(_native.thread_count())  # the same number for every peer
    machine, rows = measure_machine(), []
    for count in comparison.counts:
        scene = head_scene(count, comparison.size, comparison.size)
        for name, timing in measure(scene, comparison.rounds).items():
            rows.append(benchmark_row(name, count, (comparison.size, comparison.size), timing))
    if comparison.as_json:
        print(json.dumps({"machine": asdict(machine), "rows": [asdict(row) for row in rows]}))
        return
    print(format_machine(machine))
    for row in rows:
        print(format_row(row))


if __name__ == "__main__":
    main(tyro.cli(Comparison))
