"""Measure training steps of all methods but the default, as `mien train` runs them, and frames of two."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count as counting

import torch
from torch import Tensor

from mien import runtime
from mien.avatar.baking import make_portable
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.avatar.point_avatar.settings import PointAvatarConfig
from mien.avatar.settings import MethodConfig
from mien.avatar.textured_mesh.settings import TexturedMeshConfig
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.benchmarking import train_step
from mien.lab.benchmarking.render import GPU_COUNTS
from mien.lab.benchmarking.timing import BenchmarkRow, benchmark_row, rows_by_threads, time_function
from mien.training.checkpoint import TrainingState
from mien.training.trainer import TrainingData, start, step

Case = tuple[TrainingState, TrainingData]
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
    camera = data.targets[0].camera(0)
    draw = lambda face: train_step.pose_and_render(state.avatar, face, camera)  # noqa: E731
    yield from _frame_rows("headgas_frame", draw, state, seconds)
    yield from _frame_rows("headgas_runtime_frame", _runtime_frame(state, data), state, seconds)


def mono_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps with the sizes of the preset `standard`, and frames of the runtime, by threads.

    Times of a step are divided by its number of frames.
    """
    face_model = load_face_model()
    for count in (1, 2, 4, 8):
        case = mono_case(face_model, 10_000, _SIZE, count)
        for row in train_step.step_rows(f"mono_step_{count}_frames", 10_000, _SIZE, *case, seconds):
            yield per_frame(row, count)
    state, data = mono_case(face_model, _COUNT, _SIZE)
    yield from _frame_rows("mono_runtime_frame", _runtime_frame(state, data), state, seconds)


def headgas_on_gpu(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """Measure whole steps with the paper's features on the device of `like`, by Gaussians, at 512x512."""
    config, model = HeadGasConfig(features=32, sh_degree=3), load_face_model()
    return _rows_by_count(lambda count: headgas_case(model, config, count, _SIZE, like), like, seconds)


def mono_on_gpu(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """The same for points of MonoGaussianAvatar, one frame a step, in networks as wide as the default has them."""
    model = load_face_model()
    return _rows_by_count(lambda count: mono_case(model, count, _SIZE, like=like), like, seconds)


def point_avatar_on_gpu(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """The same for points of PointAvatar."""
    config = PointAvatarConfig(frames_per_step=1)
    sized = lambda count: replace(config, points=count, max_points=count)  # noqa: E731
    return _rows_by_count(lambda count: _first_case(sized(count), like), like, seconds)


def textured_mesh_on_gpu(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """The same for surfels of a textured mesh, whose number is about the given one."""
    return _rows_by_count(lambda count: _first_case(TexturedMeshConfig(surfels=count), like), like, seconds)


def _rows_by_count(make: Callable[[int], Case], like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    for count in GPU_COUNTS:
        state, data = make(count)
        run = lambda state=state, data=data: step(state, data, train_step.SETTINGS)  # noqa: E731
        yield benchmark_row("train_step", count, _SIZE, time_function(run, seconds, like=like), like)


def _first_case(config: MethodConfig, like: Tensor) -> Case:
    """The state before the first step, and its pictures."""
    sequence = train_step.benchmark_sequence(load_face_model(), *_SIZE)
    state = start([sequence], load_face_model(), config, train_step.SETTINGS, like)
    train_step.paint_targets(sequence, state.avatar, like)
    return state, train_step.case_data(sequence, like=like)


def _runtime_frame(state: TrainingState, data: TrainingData) -> Callable[[FaceParams], None]:
    """A function that poses and renders a picture of the baked avatar, as `mien.runtime` does."""
    avatar = runtime.Avatar(make_portable(state.avatar, data.targets[0].camera(0), "benchmark"))

    def draw(face: FaceParams) -> None:
        parts = (face.expression, face.joints, face.head_rotation, face.head_translation)
        avatar.render(runtime.pose(avatar.portable.baked, runtime.Face(*(part[0].numpy() for part in parts))))

    return draw


def _frame_rows(
    name: str, draw: Callable[[FaceParams], None], state: TrainingState, seconds: float
) -> Iterator[BenchmarkRow]:
    face, frames = state.track.params(), counting()
    frame = lambda: draw(face[next(frames) % train_step.TIMESTEPS])  # noqa: E731
    return rows_by_threads(name, _COUNT, _SIZE, frame, seconds / 3)


def headgas_case(
    face_model: FaceModel, config: HeadGasConfig, count: int, size: tuple[int, int], like: Tensor = train_step.ON_CPU
) -> Case:
    """Return a state in the middle of a run with `count` Gaussians, and its pictures of (width, height) `size`.

    The Gaussians are copies of 3,000 points on the mesh, nearby.
    """
    sequence = train_step.benchmark_sequence(face_model, *size)
    state = start([sequence], face_model, replace(config, points=3_000), train_step.SETTINGS, like)
    assert isinstance(state.avatar, HeadGas)
    _fill_headgas(state.avatar, count)
    assert state.density is not None
    state.density.load_state(train_step.empty_statistics(count))
    train_step.paint_targets(sequence, state.avatar, like)
    return state, train_step.case_data(sequence, like=like)


@torch.no_grad()
def _fill_headgas(avatar: HeadGas, count: int) -> None:
    """Give an avatar small and mostly opaque Gaussians that change with the expression, as training would."""
    store, generator = avatar.store, torch.Generator().manual_seed(0)
    store.select(torch.arange(count) % len(store))
    store.assign("means", store["means"] + 0.002 * torch.randn(count, 3, generator=generator).to(store["means"]))
    store.assign("quats", torch.randn(count, 4, generator=generator))
    spread = 0.35 * torch.randn(count, 3, generator=generator)
    store.assign("log_scales", spread - 7.5 - 0.5 * torch.tensor(count / 30_000).log())
    for name in ("bases", "neutral_features"):
        store.assign(name, 0.3 * torch.randn(store[name].shape, generator=generator))
    last = avatar.network[-1]
    assert isinstance(last, torch.nn.Linear)
    last.bias[-1] = 2.0


def per_frame(row: BenchmarkRow, frames: int) -> BenchmarkRow:
    """The times of one of a step's frames."""
    return replace(row, min_ms=row.min_ms / frames, median_ms=row.median_ms / frames, cpu_ms=row.cpu_ms / frames)


def mono_case(
    face_model: FaceModel, count: int, size: tuple[int, int], frames: int = 1, like: Tensor = train_step.ON_CPU
) -> Case:
    """Return a state late in a run with `count` points near the mesh, and its pictures of (width, height) `size`.

    Steps use `frames` frames.
    """
    sequence = train_step.benchmark_sequence(face_model, *size)
    config = MonoGaussianAvatarConfig(points=len(face_model.template), frames_per_step=frames)
    state = start([sequence], face_model, config, train_step.SETTINGS, like)
    assert isinstance(state.avatar, MonoGaussianAvatar)
    _fill_mono(state.avatar, count)
    # Late in the run radii are small, and no round of density control is near.
    state.step = round(0.9 * train_step.SETTINGS.steps) + 1
    assert state.density is not None
    state.density.load_state({"opacity": torch.zeros(count)})
    train_step.paint_targets(sequence, state.avatar, like)
    return state, train_step.case_data(sequence, like=like)


@torch.no_grad()
def _fill_mono(avatar: MonoGaussianAvatar, count: int) -> None:
    """Put points near the vertices, and let attributes differ from point to point, as after training."""
    store, generator = avatar.store, torch.Generator().manual_seed(0)
    store.assign("means", avatar.face_model.head_vertices(avatar.canonical_face())[0])
    store.select(torch.arange(count) % len(store))
    store.assign("means", store["means"] + 0.002 * torch.randn(count, 3, generator=generator).to(store["means"]))
    for network in (avatar.attributes, avatar.deformation, avatar.change):
        for parameter in network.parameters():
            parameter.add_(0.01 * torch.randn(parameter.shape, generator=generator).to(parameter))
