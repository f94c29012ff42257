"""Measure a `mono_gaussian_avatar` training step, as `mien train` runs it, and a frame of the baked avatar."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count as counting

import torch

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.benchmarking import train_step
from mien.lab.benchmarking.timing import BenchmarkRow, rows_by_threads
from mien.training.checkpoint import TrainingState
from mien.training.trainer import TrainingData, start

_SIZE = (512, 512)


def mono_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps with the sizes of the preset `standard`, and frames of the runtime, by threads.

    Times of a step are divided by its number of frames.
    """
    face_model = load_face_model()
    for count in (1, 2, 4, 8):
        case = mono_case(face_model, 10_000, _SIZE, count)
        for row in train_step.step_rows(f"mono_step_{count}_frames", 10_000, _SIZE, *case, seconds):
            yield per_frame(row, count)
    state, data = mono_case(face_model, 30_000, _SIZE)
    camera, face, frames = data.targets[0].camera(0), state.track.params(), counting()
    portable = runtime.Avatar(make_portable(state.avatar, camera, "benchmark"))
    yield from rows_by_threads(
        "mono_runtime_frame",
        30_000,
        _SIZE,
        lambda: train_step.runtime_frame(portable, face[next(frames) % train_step.TIMESTEPS]),
        seconds / 3,
    )


def per_frame(row: BenchmarkRow, frames: int) -> BenchmarkRow:
    """The times of one of a step's frames."""
    return replace(row, min_ms=row.min_ms / frames, median_ms=row.median_ms / frames, cpu_ms=row.cpu_ms / frames)


def mono_case(
    face_model: FaceModel, count: int, size: tuple[int, int], frames: int = 1
) -> tuple[TrainingState, TrainingData]:
    """Return a state late in a run with `count` points near the mesh, and its pictures of (width, height) `size`.

    Steps use `frames` frames.
    """
    sequence = train_step.benchmark_sequence(face_model, *size)
    config = MonoGaussianAvatarConfig(points=len(face_model.template), frames_per_step=frames)
    state = start([sequence], face_model, config, train_step.SETTINGS)
    assert isinstance(state.avatar, MonoGaussianAvatar)
    _fill(state.avatar, count)
    # Late in the run radii are small, and no round of density control is near.
    state.step = round(0.9 * train_step.SETTINGS.steps) + 1
    assert state.density is not None
    state.density.load_state({"opacity": torch.zeros(count)})
    train_step.paint_targets(sequence, state.avatar)
    return state, train_step.case_data(sequence)


@torch.no_grad()
def _fill(avatar: MonoGaussianAvatar, count: int) -> None:
    """Put points near the vertices, and let attributes differ from point to point, as after training."""
    store, generator = avatar.store, torch.Generator().manual_seed(0)
    store.assign("means", avatar.face_model.head_vertices(avatar.canonical_face())[0])
    store.select(torch.arange(count) % len(store))
    store.assign("means", store["means"] + 0.002 * torch.randn(count, 3, generator=generator))
    for network in (avatar.attributes, avatar.deformation, avatar.change):
        for parameter in network.parameters():
            parameter.add_(0.01 * torch.randn(parameter.shape, generator=generator))
