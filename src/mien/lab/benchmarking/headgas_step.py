"""Measure a `headgas` training step, as `mien train` runs it, and a frame at a changing expression."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count as counting

import torch

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.benchmarking import train_step
from mien.lab.benchmarking.timing import BenchmarkRow, rows_by_threads
from mien.training.checkpoint import TrainingState
from mien.training.trainer import TrainingData, start

_COUNT, _SIZE = 30_000, (512, 512)


def headgas_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps and frames at 512x512 by directions and threads.

    `headgas_step` has the directions of the preset `standard`, `headgas_step_all` those of all inputs of the face.
    Frames are posed by the avatar itself (`headgas_frame`) and by the runtime (`headgas_runtime_frame`); each frame has
    another expression.
    """
    config = HeadGasConfig(features=32, sh_degree=3)
    face_model = load_face_model()
    for name, directions in (("headgas_step", config.directions), ("headgas_step_all", 0)):
        state, data = headgas_case(face_model, replace(config, directions=directions), _COUNT, _SIZE)
        yield from train_step.step_rows(name, _COUNT, _SIZE, state, data, seconds)
    state, data = headgas_case(face_model, config, _COUNT, _SIZE)
    camera, face, frames = data.targets[0].camera(0), state.track.params(), counting()
    portable = runtime.Avatar(make_portable(state.avatar, camera, "benchmark"))
    for name, draw in (
        ("headgas_frame", lambda face: train_step.pose_and_render(state.avatar, face, camera)),
        ("headgas_runtime_frame", lambda face: train_step.runtime_frame(portable, face)),
    ):
        frame = lambda draw=draw: draw(face[next(frames) % train_step.TIMESTEPS])  # noqa: E731
        yield from rows_by_threads(name, _COUNT, _SIZE, frame, seconds / 3)


def headgas_case(
    face_model: FaceModel, config: HeadGasConfig, count: int, size: tuple[int, int]
) -> tuple[TrainingState, TrainingData]:
    """Return a state in the middle of a run with `count` Gaussians, and its pictures of (width, height) `size`.

    The Gaussians are copies of 3,000 points on the mesh, nearby.
    """
    sequence = train_step.benchmark_sequence(face_model, *size)
    state = start([sequence], face_model, replace(config, points=3_000), train_step.SETTINGS)
    assert isinstance(state.avatar, HeadGas)
    _fill(state.avatar, count)
    assert state.density is not None
    state.density.load_state(train_step.empty_statistics(count))
    train_step.paint_targets(sequence, state.avatar)
    return state, train_step.case_data(sequence)


@torch.no_grad()
def _fill(avatar: HeadGas, count: int) -> None:
    """Give an avatar small and mostly opaque Gaussians that change with the expression, as training would."""
    store, generator = avatar.store, torch.Generator().manual_seed(0)
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
