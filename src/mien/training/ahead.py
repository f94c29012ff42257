"""Prepare the pictures of the next training steps while a step runs, so that no step waits for a picture."""

import copy
from collections import deque
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Items
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import cv2
import torch

from mien.training.footage.frames import FrameOrder, background_at
from mien.training.footage.sequence import Target, Targets
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
