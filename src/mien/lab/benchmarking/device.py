"""Measure how fast a GPU renders and trains at the sizes that papers report.

Run as `mien bench render|train-step --device cuda`.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from mien.face.loading import load_face_model
from mien.lab.benchmarking.render import draw, draw_and_differentiate
from mien.lab.benchmarking.scenes import Scene, head_scene
from mien.lab.benchmarking.timing import BenchmarkRow, Timing, device_row, time_function
from mien.lab.benchmarking.train_step import SETTINGS, pose_and_render, training_case
from mien.training.trainer import step

COUNTS = (30_000, 100_000)
SIZES = ((512, 512), (550, 802))
"""Width and height of HeadGaS's figure and of GaussianAvatars' table (802x550 there is height x width)."""


def render_rows(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """Measure forward alone, and forward with backward, on the device of `like`."""
    for count in COUNTS:
        for size in SIZES:
            scene = _scene_on(head_scene(count, *size), like)
            for name, work in (("forward", draw), ("forward_backward", draw_and_differentiate)):
                timing = _timed(like, lambda scene=scene, work=work: work(scene, "auto"), seconds)
                yield device_row(f"rasterize_{name}", count, size, timing, like)


def train_step_rows(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """Measure whole `gaussian_avatars` steps as `mien train` runs them, and posing with rendering."""
    face_model = load_face_model()
    for count in COUNTS:
        for size in SIZES:
            state, data = training_case(face_model, count, *size, like)
            timing = _timed(like, lambda state=state, data=data: step(state, data, SETTINGS), seconds)
            yield device_row("train_step", count, size, timing, like)
            scene = (state.avatar, state.track.params(), data.targets[0].camera(0))
            timing = _timed(like, lambda scene=scene: pose_and_render(*scene), seconds / 3)
            yield device_row("pose_and_render", count, size, timing, like)


def _timed(like: Tensor, work: Callable[[], object], seconds: float) -> Timing:
    """Time each run until the device has finished it."""

    def run() -> None:
        work()
        if like.is_cuda:
            torch.cuda.synchronize(like.device)

    return time_function(run, seconds)


def _scene_on(scene: Scene, like: Tensor) -> Scene:
    names = ("means", "quats", "scales", "opacities", "sh")
    leaves = {name: getattr(scene.gaussians, name).detach().to(like).requires_grad_() for name in names}
    return Scene(
        replace(scene.gaussians, **leaves), scene.camera.to(like), scene.background.to(like), scene.gradient.to(like)
    )
