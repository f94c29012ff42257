"""Measure a `gaussian_avatars` training step, as `mien train` runs it, on a sequence that needs no footage."""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.gaussian_avatars.settings import as_published
from mien.camera import Camera
from mien.capture.capture import Capture
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.benchmarking.render import GPU_COUNTS, PAPER_SIZES
from mien.lab.benchmarking.timing import BenchmarkRow, Timing, benchmark_row, rows_by_threads, time_function
from mien.render import rasterize
from mien.tracking.tracking import Tracking
from mien.training.batch import targets_ahead
from mien.training.checkpoint import TrainingState
from mien.training.footage.frames import FrameOrder, training_frames
from mien.training.footage.sequence import Sequence, Targets
from mien.training.settings import TrainSettings
from mien.training.trainer import TrainingData, start, step

TIMESTEPS = 20
SETTINGS = TrainSettings(
    steps=1_000_000_000, split="none", background="white", edges="filmed", inside="free", unseen="trained"
)
"""So many steps that no density control happens during the measurement, and no part of a run that closes heads."""
ON_CPU = torch.zeros(())


def train_step_suite(seconds: float = 3.0) -> Iterator[BenchmarkRow]:
    """Measure whole steps at 512x512 by Gaussians and threads, and posing with rendering at the papers' sizes."""
    for count in (10_000, 30_000, 100_000):
        state, data = training_case(load_face_model(), count, 512, 512)
        yield from step_rows("train_step", count, (512, 512), state, data, seconds)
    for count, size in ((30_000, (512, 512)), (100_000, (550, 802))):
        state, data = training_case(load_face_model(), count, *size)
        scene = (state.avatar, state.track.params(), data.targets[0].camera(0))
        yield from rows_by_threads(
            "pose_and_render", count, size, lambda scene=scene: pose_and_render(*scene), seconds / 3
        )
    yield from waiting_rows(load_face_model(), 30_000, (550, 802), seconds / 3)


def gpu_rows(like: Tensor, seconds: float) -> Iterator[BenchmarkRow]:
    """Measure whole steps, and posing with rendering, on the device of `like` at the papers' sizes."""
    for count in GPU_COUNTS:
        for size in PAPER_SIZES.values():
            state, data = training_case(load_face_model(), count, *size, like)
            timing = time_function(lambda state=state, data=data: step(state, data, SETTINGS), seconds, like=like)
            yield benchmark_row("train_step", count, size, timing, like)
            scene = (state.avatar, state.track.params(), data.targets[0].camera(0))
            timing = time_function(lambda scene=scene: pose_and_render(*scene), seconds / 3, like=like)
            yield benchmark_row("pose_and_render", count, size, timing, like)


def step_rows(
    name: str, count: int, size: tuple[int, int], state: TrainingState, data: TrainingData, seconds: float
) -> Iterator[BenchmarkRow]:
    """Measure whole steps of a case by threads."""
    return rows_by_threads(name, count, size, lambda: step(state, data, SETTINGS), seconds)


def waiting_rows(face_model: FaceModel, count: int, size: tuple[int, int], seconds: float) -> Iterator[BenchmarkRow]:
    """Measure what a step waits for its picture when no more pictures can be cached: ahead of it, and made by itself.

    Random backgrounds are never cached. The processor time is that of the step's own thread.
    """
    settings = replace(SETTINGS, background="random")
    state, data = training_case(face_model, count, *size)
    with targets_ahead(data.order, data.targets_at, settings) as ahead:
        for name, own in (("wait_for_target", replace(data, ahead=ahead)), ("make_target", data)):
            waits, processors = [], []
            end = time.perf_counter() + seconds
            while len(waits) < 7 or time.perf_counter() < end:
                processor, began = time.thread_time(), time.perf_counter()
                own.target(state.step, settings)
                waits.append(1e3 * (time.perf_counter() - began))
                processors.append(1e3 * (time.thread_time() - processor))
                step(state, data, SETTINGS)
            timing = Timing(min(waits), sorted(waits)[len(waits) // 2], min(processors))
            yield benchmark_row(name, count, size, timing)


def pose_and_render(avatar: Avatar, face: FaceParams, camera: Camera) -> None:
    """Pose the avatar and render one picture."""
    with torch.no_grad():
        gaussians = avatar.pose(face[0]).gaussians.timestep(0)
        rasterize(gaussians, camera, gaussians.means.new_ones(3))


def training_case(
    face_model: FaceModel, count: int, width: int, height: int, like: Tensor = ON_CPU
) -> tuple[TrainingState, TrainingData]:
    """Return a state in the middle of a run with `count` Gaussians, and its pictures, half of which the head covers.

    Both have the float dtype and the device of `like`.
    """
    sequence = benchmark_sequence(face_model, width, height)
    state = start([sequence], face_model, as_published(), SETTINGS, like)
    _grow(state.avatar, count)
    state = TrainingState(state.avatar, state.adam, state.density, state.track, {})
    assert state.density is not None
    state.density.load_state(empty_statistics(count))
    paint_targets(sequence, state.avatar, like)
    return state, case_data(sequence, like=like)


def case_data(sequence: Sequence, settings: TrainSettings = SETTINGS, like: Tensor = ON_CPU) -> TrainingData:
    """Return the pictures of a case in a training's order."""
    order = FrameOrder(training_frames([sequence], settings), seed=0)
    return TrainingData(order, (Targets(sequence, 0, like=like, cleaned=settings.edges == "cleaned"),))


def empty_statistics(count: int) -> dict[str, Tensor]:
    """The statistics of density control for `count` Gaussians that no step has seen."""
    floats = {name: torch.zeros(count) for name in ("pull", "seen", "opacity")}
    return floats | {"radius": torch.zeros(count, dtype=torch.int32)}


def _grow(avatar: Avatar, count: int) -> None:
    """Grow an avatar as density control would: several Gaussians per triangle, small and mostly opaque."""
    store, generator = avatar.store, torch.Generator().manual_seed(0)
    faces = len(store)
    store.select(torch.arange(count) % faces)
    store.assign("means", 0.5 * torch.randn(count, 3, generator=generator))
    store.assign("quats", torch.randn(count, 4, generator=generator))
    spread = 0.5 * torch.randn(count, 3, generator=generator)
    store.assign("log_scales", spread - 2.3 - 0.5 * np.log(count / 30_000))
    store.assign("opacity_logits", 2 + 1.5 * torch.randn(count, generator=generator))
    store.assign("sh_constant", 0.5 * torch.randn(count, 1, 3, generator=generator))


def benchmark_sequence(face_model: FaceModel, width: int, height: int) -> Sequence:
    """Return a head that turns and opens its mouth a little, with pictures that are still black."""
    time = torch.linspace(0, 2 * torch.pi, TIMESTEPS + 1)[:-1]
    neutral = face_model.neutral(TIMESTEPS)
    turn = torch.stack([0.1 * time.sin(), 0.2 * time.cos(), 0 * time], -1)
    strengths = 0.3 * torch.rand(neutral.expression.shape[-1], generator=torch.Generator().manual_seed(1))
    expression = neutral.expression + strengths * time.sin()[:, None].abs()
    place = torch.tensor([0.0, 0.02, -0.6]).expand(TIMESTEPS, 3)
    face = FaceParams(neutral.identity, expression, neutral.joints, turn, place.contiguous())
    focal = 1.8 * min(width, height)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])), width, height)
    tracking = Tracking(
        face_model=face_model.name, face_model_hash=face_model.content_hash, face=face,
        valid=torch.ones(TIMESTEPS, dtype=torch.bool), cameras=(camera,),
        neck_lines=torch.tensor([0.0, -1.0, float(height)]).expand(TIMESTEPS, 1, 3),
        residuals=torch.zeros(TIMESTEPS, 1),
    )  # fmt: skip
    pictures = np.zeros((TIMESTEPS, 1, height, width, 3), np.uint8)
    capture = Capture(
        name="benchmark", camera_ids=("front",), fps=25.0, timestamps=np.arange(TIMESTEPS) / 25, images=pictures,
        mattes=np.zeros(pictures.shape[:-1], np.uint8), landmarks=np.zeros((TIMESTEPS, 1, 478, 2), np.float32),
        valid=np.ones((TIMESTEPS, 1), bool), principal_point=np.array([[width / 2, height / 2]], np.float32),
        source={},
    )  # fmt: skip
    return Sequence("benchmark", capture, tracking, np.zeros(pictures.shape[:-1], np.uint8))


def paint_targets(sequence: Sequence, avatar: Avatar, like: Tensor = ON_CPU) -> None:
    """Paint pictures of the same head in noisy colours, so that every loss has a gradient."""
    noise = np.random.default_rng(0)
    for timestep in range(TIMESTEPS):
        with torch.no_grad():
            gaussians = avatar.pose(sequence.tracking.face[timestep].to(like)).gaussians.timestep(0)
            rendering = rasterize(gaussians, sequence.tracking.cameras[0], like.new_ones(3))
        picture = 255 * rendering.image.cpu().numpy() + noise.normal(0, 20, rendering.image.shape)
        sequence.capture.images[timestep, 0] = picture.clip(0, 255).astype(np.uint8)
        matte = (255 * rendering.alpha.cpu().numpy()).astype(np.uint8)
        sequence.scoring[timestep, 0] = sequence.capture.mattes[timestep, 0] = matte
