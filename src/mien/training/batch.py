"""The frames of one optimiser step: which they are, their pictures, and their losses.

Most methods use one frame in a step. Of several, networks of positions run once. While a step runs, a worker prepares
the pictures of the next ones, so that no step waits for a picture.
"""

import copy
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Items
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.avatar.avatar import ParameterGroup, Posed
from mien.avatar.settings import PerceptualLoss, Progress
from mien.camera import Camera
from mien.face.params import concatenate
from mien.gaussians import Rendering
from mien.render import rasterize
from mien.render.rasterize import rasterize_each
from mien.training.checkpoint import TrainingState
from mien.training.footage.frames import CROP, LEAST_EXTENT, BatchFrame, Frame, FrameOrder, background_at, random_at
from mien.training.footage.sequence import Target, Targets
from mien.training.losses import PerceptualGoal, perceptual_goal, perceptual_loss, picture_losses
from mien.training.settings import TrainSettings

Result = TypeVar("Result")
TargetsAt = Callable[[int], Items[Targets]]
"""Gives the targets of a step, one entry per sequence."""

AHEAD = 4
"""Number of steps whose pictures are prepared in advance. It bounds the memory: each has 4 bytes a pixel."""


class TargetQueue:
    """The targets of consecutive steps. One worker thread reads and composites those of the next few steps.

    Frame and background of a step are known functions of its number, so a target does not depend on when it is made.
    """

    def __init__(self, order: FrameOrder, targets: TargetsAt, settings: TrainSettings, worker: ThreadPoolExecutor):
        # The order remembers the epoch that it was asked for last, and the trainer asks for earlier steps.
        self._order, self._targets, self._settings, self._worker = copy.copy(order), targets, settings, worker
        self._next = 0
        self._waiting: deque[Target | Future[Target]] = deque()

    def target(self, step: int) -> Target:
        """The target of a step. Ask for the steps in their order; after a jump, the queue starts again."""
        if step != self._next - len(self._waiting):
            self.close()
            self._next = step
        while self._next <= step + AHEAD and (self._next <= step or self._next < self._settings.steps):
            self._waiting.append(self._planned(self._next))
            self._next += 1
        found = self._waiting.popleft()
        return found.result() if isinstance(found, Future) else found

    def meanwhile(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Let the worker call a function after the pictures that it was asked for so far."""
        return self._worker.submit(function, *arguments)

    def close(self) -> None:
        """Forget the targets that nobody will ask for."""
        for entry in self._waiting:
            if isinstance(entry, Future):
                entry.cancel()
        self._waiting.clear()

    def _planned(self, step: int) -> Target | Future[Target]:
        frame, _ = self._order.at(step)
        targets, background = self._targets(step)[frame.sequence], background_at(self._settings, step)
        kept = targets.kept(frame.timestep, frame.camera, background)
        if kept is not None:
            return kept
        keep = self._settings.background == "white"
        return self._worker.submit(targets.composed, frame.timestep, frame.camera, background, keep)


@contextmanager
def targets_ahead(order: FrameOrder, targets: TargetsAt, settings: TrainSettings) -> Iterator[TargetQueue]:
    """A queue whose worker ends with the block, also after an error. `targets` gives the targets of a step."""
    cv2_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # OpenCV's own threads and those of the step would wait for each other.
    # torch limits the threads of its operations for each thread apart.
    limit = partial(torch.set_num_threads, torch.get_num_threads())
    worker = ThreadPoolExecutor(1, thread_name_prefix="mien-targets", initializer=limit)
    try:
        yield TargetQueue(order, targets, settings, worker)
    finally:
        worker.shutdown(wait=True, cancel_futures=True)
        cv2.setNumThreads(cv2_threads)


LEAST_HALVED = 384  # least longer side of pictures that are halved at the start of a run, in pixels


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Data that training reads and never changes."""

    order: FrameOrder
    targets: tuple[Targets, ...]
    """One entry per sequence."""
    extent: float = field(default_factory=lambda: LEAST_EXTENT)
    """Extent of the training cameras, in metres."""
    representative: tuple[Frame, ...] = ()
    """A few frames that show the head from all the sides that were filmed."""
    coarse: tuple[Targets, ...] = ()
    """The targets of the first `coarse_steps` steps, at half the size."""
    coarse_steps: int = 0
    ahead: TargetQueue | None = None
    """Prepares the targets of the next steps in another thread. If it is None, each step makes its own."""
    each: Callable[[Items[Callable[[], Any]]], list[Any]] = lambda calls: [call() for call in calls]
    """Calls functions, on threads of their own if there are some, and returns their results in order."""

    def targets_at(self, step: int) -> tuple[Targets, ...]:
        """The targets of a step, one entry per sequence."""
        return self.coarse if step < self.coarse_steps else self.targets

    def camera(self, frame: Frame) -> Camera:
        """The camera of a frame, at training resolution."""
        return self.targets[frame.sequence].camera(frame.camera)

    def target(self, step: int, settings: TrainSettings) -> Target:
        """The target of a step. It does not depend on `ahead`."""
        frame, _ = self.order.at(step)
        targets = self.targets_at(step)[frame.sequence]
        if self.ahead is not None:
            return targets.moved(self.ahead.target(step))
        background = background_at(settings, step)
        return targets.target(frame.timestep, frame.camera, background, keep=settings.background == "white")

    def goal(
        self, target: Target, perceptual: PerceptualLoss, step: int, settings: TrainSettings
    ) -> Callable[[], PerceptualGoal]:
        """A function that returns the goal of a step's perceptual loss. With `ahead`, it is made meanwhile."""
        make = partial(perceptual_goal, target, perceptual, random_at(settings.seed, CROP, step))
        return self.meanwhile(make) if target.background.device.type == "cpu" else make

    def meanwhile(self, make: Callable[[], Result]) -> Callable[[], Result]:
        """A function that returns what `make` does. With `ahead`, another thread begins at once."""
        return make if self.ahead is None else self.ahead.meanwhile(make).result


def coarse_steps(targets: Items[Targets], settings: TrainSettings) -> int:
    """Number of steps at the start of a run whose pictures are halved: none if some of the pictures are small."""
    large = all(max(one.width, one.height) >= LEAST_HALVED for one in targets)
    return round((settings.coarse or 0.0) * settings.steps) if large else 0


def next_batch(state: TrainingState, data: TrainingData, settings: TrainSettings) -> list[BatchFrame]:
    """The frames of the next step: as many as the avatar asks for and the run has left."""
    perceptual = state.avatar.config.photometric.perceptual
    wanted = state.avatar.extras.frames_per_step(state.step / settings.steps)
    count, batch = max(1, min(wanted, settings.steps - state.step)), []
    for number in range(state.step, state.step + count):
        frame, _ = data.order.at(number)
        target, due = data.target(number, settings), perceptual.due(number, settings.steps)
        goal = data.goal(target, perceptual, number, settings) if due else None
        targets, index = data.targets_at(number)[frame.sequence], state.track.index_of(frame.sequence, frame.timestep)
        cameras = targets.camera(frame.camera), targets.cameras_on_cpu[frame.camera]
        batch.append(BatchFrame(number, frame, index, state.track.face(index), *cameras, target, goal))
    return batch


def draw(
    state: TrainingState, batch: Items[BatchFrame], progress: Progress
) -> tuple[Posed, list[Posed], list[Rendering]]:
    """The Gaussians of all frames, posed together; the same frame by frame, as they are drawn; and their pictures."""
    faces = [one.face for one in batch]
    posed = state.graph.pose(state.avatar, faces[0] if len(faces) == 1 else concatenate(faces), progress)
    each = [posed] if len(batch) == 1 else [replace(posed, gaussians=own) for own in posed.gaussians.timesteps()]
    if state.head is not None:
        each = [state.head.posed(own, one) for one, own in zip(batch, each, strict=True)]
    views = [(own.gaussians.timestep(0), one.camera) for one, own in zip(batch, each, strict=True)]
    backgrounds = [one.target.background for one in batch]
    whole = each[0] if len(batch) == 1 else posed
    if len(batch) == 1 or len(batch) < _native.thread_count():  # A view that is drawn alone uses all threads.
        return whole, each, [rasterize(*view, background) for view, background in zip(views, backgrounds, strict=True)]
    return whole, each, rasterize_each(views, backgrounds)


def seen(state: TrainingState, batch: Items[BatchFrame], renderings: Items[Rendering]) -> list[Rendering]:
    """The pictures as they are compared, for example in the colours of their cameras."""
    shown = list(renderings)
    for own in state.colors:
        shown = [own.seen_by(image, one.target.background, one.frame) for one, image in zip(batch, shown, strict=True)]
    return shown


def compare(
    state: TrainingState, batch: Items[BatchFrame], shown: Items[Rendering], count: int = 0
) -> dict[str, Float[Tensor, ""]]:
    """The losses that compare pictures, by name: means over the frames, or sums over them divided by `count`."""
    own = state.avatar.config.photometric
    weights = (own if state.head is None else state.head.weights(own)).scaled(1 / (count or len(batch)))
    return _summed(picture_losses(image, one.target, weights) for one, image in zip(batch, shown, strict=True))


def compare_features(
    state: TrainingState, batch: Items[BatchFrame], shown: Items[Rendering], count: int = 0
) -> dict[str, Float[Tensor, ""]]:
    """The perceptual loss, if it is due in one of the frames: as `compare`."""
    settings = state.avatar.config.photometric.perceptual.scaled(1 / (count or len(batch)))
    return _summed(
        {"perceptual": perceptual_loss(image, one.goal(), settings)}
        for one, image in zip(batch, shown, strict=True)
        if one.goal is not None
    )


def _summed(losses: Iterable[dict[str, Float[Tensor, ""]]]) -> dict[str, Float[Tensor, ""]]:
    total: dict[str, Tensor] = {}
    for own in losses:
        for name, loss in own.items():
            total[name] = total[name] + loss if name in total else loss
    return total


def face_groups(state: TrainingState, batch: Items[BatchFrame]) -> list[ParameterGroup]:
    """The parameters of the frames' faces. A timestep that comes twice is updated once, which clears its gradient."""
    return [group for one in batch for group in state.track.parameter_groups(one.index)]
