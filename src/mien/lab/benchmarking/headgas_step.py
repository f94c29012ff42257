"""Measure a `headgas` training step, as `mien train` runs it, and a frame at a changing expression.

Run as `mien bench train-step --method headgas`.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count as counting

import torch

from mien import _native, runtime
from mien.avatar.baking import make_portable
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.benchmarking.render import thread_counts
from mien.lab.benchmarking.timing import BenchmarkRow, benchmark_row, time_function
from mien.lab.benchmarking.train_step import (
    SETTINGS,
    TIMESTEPS,
    benchmark_sequence,
    empty_statistics,
    paint_targets,
    pose_and_render,
    runtime_frame,
)
from mien.training.checkpoint import TrainingState
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from mien.training.trainer import TrainingData, start, step

COUNT, SIZE = 30_000, (512, 512)
POINTS = 3_000
"""Number of points on the mesh, of which the Gaussians are copies nearby."""


def headgas_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps and frames at 512x512 by directions and threads.

    `headgas_step` has the directions of the preset `standard`, `headgas_step_all` those of all inputs of the face.
    Frames are posed by the avatar itself (`headgas_frame`) and by the runtime (`headgas_runtime_frame`); each frame has
    another expression.
    """
    config = HeadGasConfig(features=32, sh_degree=3)
    face_model = load_face_model()
    for name, directions in (("headgas_step", config.directions), ("headgas_step_all", 0)):
        state, data = headgas_case(face_model, replace(config, directions=directions), COUNT, SIZE)
        for threads in thread_counts():
            _native.set_thread_count(threads)
            timing = time_function(lambda state=state, data=data: step(state, data, SETTINGS), seconds)
            yield benchmark_row(name, COUNT, SIZE, timing)
    state, data = headgas_case(face_model, config, COUNT, SIZE)
    camera, face, frames = data.targets[0].camera(0), state.track.params(), counting()
    portable = runtime.Avatar(make_portable(state.avatar, camera, "benchmark"))
    for threads in thread_counts():
        _native.set_thread_count(threads)
        timing = time_function(
            lambda: pose_and_render(state.avatar, face[next(frames) % TIMESTEPS], camera), seconds / 3
        )
        yield benchmark_row("headgas_frame", COUNT, SIZE, timing)
        timing = time_function(lambda: runtime_frame(portable, face[next(frames) % TIMESTEPS]), seconds / 3)
        yield benchmark_row("headgas_runtime_frame", COUNT, SIZE, timing)


def headgas_case(
    face_model: FaceModel, config: HeadGasConfig, count: int, size: tuple[int, int]
) -> tuple[TrainingState, TrainingData]:
    """Return a state in the middle of a run with `count` Gaussians, and its pictures of (width, height) `size`."""
    sequence = benchmark_sequence(face_model, *size)
    state = start([sequence], face_model, replace(config, points=POINTS), SETTINGS)
    avatar = state.avatar
    assert isinstance(avatar, HeadGas)
    _fill(avatar, count)
    assert state.density is not None
    state.density.load_state(empty_statistics(count))
    paint_targets(sequence, avatar, torch.zeros(()))
    order = FrameOrder(training_frames([sequence], SETTINGS), seed=0)
    return state, TrainingData(order, (Targets(sequence, 0),))


@torch.no_grad()
def _fill(avatar: HeadGas, count: int) -> None:
    """Give an avatar small and mostly opaque Gaussians that change with the expression, as training would."""
    store, generator = avatar.gaussian_store(), torch.Generator().manual_seed(0)
    store.select(torch.arange(count) % len(store))
    store.assign("means", store["means"] + 0.002 * torch.randn(count, 3, generator=generator))
    store.assign("quats", torch.randn(count, 4, generator=generator))
    spread = 0.35 * torch.randn(count, 3, generator=generator)
    store.assign("log_scales", spread - 7.5 - 0.5 * torch.tensor(count / 30_000).log())
    for name in ("bases", "neutral_features"):
        store.assign(name, 0.3 * torch.randn(store[name].shape, generator=generator))
    last = avatar.network[-1]
    assert isinstance(last, torch.nn.Linear)
    last.bias[-1] = 2.0
