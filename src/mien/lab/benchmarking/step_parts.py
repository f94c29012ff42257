"""Measure the parts of a training step of the default method (`mien bench train-step --parts`).

Each native operation has a row of its own. What remains of a phase is the work of Python and PyTorch in it.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import torch

from mien import _native
from mien.avatar.methods import DEFAULT_METHOD
from mien.face.loading import load_face_model
from mien.face.model import FaceModel
from mien.lab.benchmarking import train_step
from mien.lab.benchmarking.timing import thread_counts
from mien.machine.terminal import counted
from mien.training import apart, trainer
from mien.training.checkpoint import TrainingState
from mien.training.settings import PRESETS, TrainSettings, resolved
from mien.training.trainer import TrainingData, start, step

COUNT, SIZE = 45_000, (512, 512)
"""Gaussians and picture size that the aims of speed are given for."""
ROUND = 48
"""Number of steps that are measured together: rare losses are due in the same number of them each time."""
REST = "Python and PyTorch"
_PHASES: dict[str, tuple[tuple[Any, str], ...]] = {
    "frame": ((trainer, "next_batch"),),
    "pose and draw": ((trainer, "draw"), (apart, "draw")),
    "losses of pictures": ((trainer, "compare"), (apart, "compare")),
    "perceptual loss": ((trainer, "compare_features"), (apart, "compare_features")),
    "backward": ((torch.autograd, "backward"), (torch.autograd, "grad")),
    "update": ((trainer, "_update"),),
}
"""The parts of `trainer.step`, by name: where each function is looked up, and its name there."""
_OF_WHOLE_HEADS = {
    "before_step": "side views",
    "losses": "side views",
    "after_backward": "after backward",
    "after_update": "after update",
}
"""Methods of `WholeHead`, and their phases."""


@dataclass(frozen=True)
class PartRow:
    """A row of the profile."""

    phase: str
    operation: str
    """Name of a native operation, or `REST` for what remains of the phase."""
    ms: float
    """Mean over the steps of the fastest round, in milliseconds a step."""
    threads: int


@dataclass(eq=False)
class Stopwatch:
    """Times of nested calls by phase and operation, in seconds. No call counts what another one inside it takes."""

    seconds: dict[tuple[str, str], float] = field(default_factory=dict)
    _open: list[tuple[str, str]] = field(default_factory=list)
    _since: float = 0.0

    def phase(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `function`, whose time belongs to a phase."""
        return lambda *arguments, **named: self._timed((name, REST), function, arguments, named)

    def operation(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `function`, whose time belongs to an operation of the phase that calls it, if there is one."""

        def call(*arguments: Any, **named: Any) -> Any:
            if not self._open:
                return function(*arguments, **named)
            return self._timed((self._open[-1][0], name), function, arguments, named)

        return call

    def _timed(self, key: tuple[str, str], function: Callable[..., Any], arguments: Any, named: Any) -> Any:
        self._tick()
        self._open.append(key)
        try:
            return function(*arguments, **named)
        finally:
            self._tick()
            self._open.pop()

    def _tick(self) -> None:
        """Give the time since the last tick to what runs now."""
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now


def parts_suite(seconds: float = 3.0) -> Iterator[list[PartRow]]:
    """Measure the parts of a step of the default, by number of threads."""
    state, data, settings = default_case(load_face_model())
    for threads in thread_counts():
        _native.set_thread_count(threads)
        yield step_parts(state, data, settings, seconds)


def format_parts(rows: list[PartRow]) -> str:
    """Return the table of one number of threads: the phases with the longest first, and their operations."""
    phases: dict[str, float] = {}
    for row in rows:
        phases[row.phase] = phases.get(row.phase, 0.0) + row.ms
    whole = sum(phases.values())
    lines = [f"{'a step, ' + counted(rows[0].threads, 'thread'):44} {whole:8.2f} ms"]
    for phase, ms in sorted(phases.items(), key=lambda item: -item[1]):
        lines.append(f"  {phase:42} {ms:8.2f} ms {100 * ms / whole:5.1f} %")
        own = sorted((row for row in rows if row.phase == phase), key=lambda row: -row.ms)
        lines += [f"    {row.operation:40} {row.ms:8.2f} ms {100 * row.ms / whole:5.1f} %" for row in own]
    drawn = sum(row.ms for row in rows if row.operation.startswith("rasterize_views"))
    if drawn:
        lines.append(f"{'a step over its rasterizer':44} {whole / drawn:8.2f} times")
    return "\n".join(lines)


def step_parts(
    state: TrainingState, data: TrainingData, settings: TrainSettings, seconds: float = 3.0
) -> list[PartRow]:
    """Measure the parts of some steps: whole rounds for about `seconds`, of which the fastest counts.

    The state moves on. Native operations are watched wherever they are called, so every one of a step is counted.
    """
    fastest: dict[tuple[str, str], float] = {}
    for _ in range(train_step.TIMESTEPS):  # until each picture was made once
        step(state, data, settings)
    end = time.perf_counter() + seconds
    while not fastest or time.perf_counter() < end:
        watch = Stopwatch()
        with _watched(watch, state):
            whole = watch.phase("other", step)
            for _ in range(ROUND):
                whole(state, data, settings)
        if not fastest or sum(watch.seconds.values()) < sum(fastest.values()):
            fastest = watch.seconds
    threads = _native.thread_count()
    return [PartRow(*key, 1e3 * spent / ROUND, threads) for key, spent in fastest.items()]


def default_case(
    face_model: FaceModel, count: int = COUNT, size: tuple[int, int] = SIZE
) -> tuple[TrainingState, TrainingData, TrainSettings]:
    """Return a state of a run of the default with `count` Gaussians, its pictures, and its settings.

    One camera films the head, so sides are filled. Every trained Gaussian has features.
    """
    preset = PRESETS["standard"]
    settings = replace(preset.settings_of(DEFAULT_METHOD), steps=10_000_000, split="none")
    sequence = train_step.benchmark_sequence(face_model, *size)
    painter, _ = train_step.training_case(face_model, len(face_model.faces), *size)
    train_step.paint_targets(sequence, painter.avatar)
    state = start([sequence], face_model, preset.config(DEFAULT_METHOD), settings)
    settings = resolved(settings, filled=state.head is not None and state.head.fills)
    _grow(state, count)
    state.step = 6_000_000  # All losses have begun, and no density control is due.
    return state, train_step.case_data(sequence, settings), settings


def _grow(state: TrainingState, count: int) -> None:
    """Grow an avatar as density control would: several small Gaussians per triangle, all of which have features."""
    store, generator = state.avatar.store, torch.Generator().manual_seed(0)
    opened = (store["opacity_logits"].detach() < 0).nonzero()[:, 0]  # Fills are opaque from the start.
    store.append(opened[torch.arange(max(0, count - len(store))) % len(opened)])
    trained = (store["opacity_logits"].detach() < 0).nonzero()[:, 0]
    spread = 0.5 * torch.randn(len(trained), 3, generator=generator)
    drawn = {
        "means": store["means"].detach()[trained] + 0.3 * torch.randn(len(trained), 3, generator=generator),
        "quats": torch.randn(len(trained), 4, generator=generator),
        "log_scales": spread - 1.8,
        "opacity_logits": 2 + 1.5 * torch.randn(len(trained), generator=generator),
    }
    for name in ("feature_bases", "neutral_features"):
        drawn[name] = 0.1 * torch.randn(len(trained), *store[name].shape[1:], generator=generator)
    for name, values in drawn.items():
        store.assign_rows(name, trained, values)
    assert state.density is not None
    state.density.load_state(train_step.empty_statistics(len(store)))


@contextmanager
def _watched(watch: Stopwatch, state: TrainingState) -> Iterator[None]:
    """Watch all phases of the state's steps, and all native operations."""
    with ExitStack() as stack:
        for name, phase in _OF_WHOLE_HEADS.items():
            stack.enter_context(patch.object(state.head, name, watch.phase(phase, getattr(state.head, name))))
        for name, places in _PHASES.items():
            for room, function in places:
                stack.enter_context(patch.object(room, function, watch.phase(name, getattr(room, function))))
        for name in dir(_native):
            operation = getattr(_native, name)
            if callable(operation) and not isinstance(operation, type) and not name.startswith("_"):
                stack.enter_context(patch.object(_native, name, watch.operation(name, operation)))
        yield
