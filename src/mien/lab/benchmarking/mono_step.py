"""Measure a `mono_gaussian_avatar` training step, as `mien train` runs it, and a frame of the baked avatar.

Run as `mien bench train-step --method mono_gaussian_avatar`.
"""

from collections.abc import Iterator
from itertools import count as counting

import torch

from mien import _native, runtime
from mien.avatar.baking import make_portable
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.benchmarking.render import thread_counts
from mien.lab.benchmarking.timing import BenchmarkRow, Timing, benchmark_row, time_function
from mien.lab.benchmarking.train_step import SETTINGS, TIMESTEPS, benchmark_sequence, paint_targets, runtime_frame
from mien.training.checkpoint import TrainingState
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Targets
from mien.training.trainer import TrainingData, start, step

COUNT, FRAME_COUNT, SIZE = 10_000, 30_000, (512, 512)
FRAMES_PER_STEP = (1, 2, 4, 8)
_LATE_STEP = round(0.9 * SETTINGS.steps) + 1
"""A step late in the run, when radii are small. No round of density control is near it."""


def mono_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps with the sizes of the preset `standard`, and frames of the runtime, by threads.

    Times of a step are divided by its number of frames.
    """
    face_model = load_face_model()
    for frames in FRAMES_PER_STEP:
        state, data = mono_case(face_model, COUNT, SIZE, frames)
        for threads in thread_counts():
            _native.set_thread_count(threads)
            timing = time_function(lambda state=state, data=data: step(state, data, SETTINGS), seconds)
            yield benchmark_row(f"mono_step_{frames}_frames", COUNT, SIZE, per_frame(timing, frames))
    late, others = mono_case(face_model, FRAME_COUNT, SIZE)
    camera, face, frames = others.targets[0].camera(0), late.track.params(), counting()
    portable = runtime.Avatar(make_portable(late.avatar, camera, "benchmark"))
    for threads in thread_counts():
        _native.set_thread_count(threads)
        timing = time_function(lambda: runtime_frame(portable, face[next(frames) % TIMESTEPS]), seconds / 3)
        yield benchmark_row("mono_runtime_frame", FRAME_COUNT, SIZE, timing)


def per_frame(timing: Timing, frames: int) -> Timing:
    """The times of one of a step's frames."""
    return Timing(timing.min_ms / frames, timing.median_ms / frames, timing.cpu_ms / frames)


def mono_case(
    face_model: FaceModel, count: int, size: tuple[int, int], frames: int = 1
) -> tuple[TrainingState, TrainingData]:
    """Return a state late in a run with `count` points near the mesh, and its pictures of (width, height) `size`.

    Steps use `frames` frames.
    """
    sequence = benchmark_sequence(face_model, *size)
    config = MonoGaussianAvatarConfig(points=len(face_model.template), frames_per_step=frames)
    state = start([sequence], face_model, config, SETTINGS)
    assert isinstance(state.avatar, MonoGaussianAvatar)
    _fill(state.avatar, count)
    state.step = _LATE_STEP
    assert state.density is not None
    state.density.load_state({"opacity": torch.zeros(count)})
    paint_targets(sequence, state.avatar, torch.zeros(()))
    order = FrameOrder(training_frames([sequence], SETTINGS), seed=0)
    return state, TrainingData(order, (Targets(sequence, 0),))


@torch.no_grad()
def _fill(avatar: MonoGaussianAvatar, count: int) -> None:
    """Put points near the vertices, and let attributes differ from point to point, as after training."""
    store, generator = avatar.gaussian_store(), torch.Generator().manual_seed(0)
    store.assign("means", avatar.face_model.head_vertices(avatar.canonical_face())[0])
    store.select(torch.arange(count) % len(store))
    store.assign("means", store["means"] + 0.002 * torch.randn(count, 3, generator=generator))
    for network in (avatar.attributes, avatar.deformation, avatar.change):
        for parameter in network.parameters():
            parameter.add_(0.01 * torch.randn(parameter.shape, generator=generator))
