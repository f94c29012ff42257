"""The frames of a step apart: each is posed, drawn, compared and differentiated on a thread of its own.

So a step with as many frames as there are cores keeps all of them busy, from the first operator to the last. Gradients
are added up in the order of the frames: the result does not depend on the number of threads.
"""

from collections.abc import Callable, Iterator
from collections.abc import Sequence as Items
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.adam import FactoredGradient, FactoredTerm
from mien.arrays import own_derivative, sums
from mien.avatar.avatar import ParameterGroup, Posed
from mien.avatar.settings import Progress
from mien.gaussians import Rendering
from mien.training.batch import compare, compare_features, draw, seen
from mien.training.checkpoint import TrainingState
from mien.training.footage.frames import BatchFrame

Losses = dict[str, Float[Tensor, ""]]
Map = Callable[[Items[Callable[[], "Part"]]], list["Part"]]
"""Calls functions and returns their results, in their order."""


@dataclass(frozen=True, eq=False)
class Part:
    """One frame of a step, or its side view, after its backward pass."""

    losses: Losses
    """Of pictures, each as its part of the step's."""
    gradients: list[Tensor | None]
    """By the tensors that are trained, in the order of their groups."""
    terms: list[list[FactoredTerm]]
    """By the factored gradients."""
    regularizers: Losses = field(default_factory=dict)
    """Losses of the method, as if the frame were alone."""
    posed: Posed | None = None
    rendering: Rendering | None = None
    shown: Rendering | None = None
    """The rendering as it is compared."""


@dataclass(frozen=True, eq=False)
class _Trained:
    """What the losses of a step are differentiated by."""

    tensors: list[Tensor]
    factored: list[FactoredGradient]

    @staticmethod
    def of(groups: Items[ParameterGroup]) -> "_Trained":
        named = [(group, name, tensor) for group in groups for name, tensor in group.tensors.items()]
        return _Trained(
            list({id(tensor): tensor for group, name, tensor in named if name not in group.factored}.values()),
            list({id(own): own for group in groups for own in group.factored.values()}.values()),
        )

    def by(
        self, losses: Losses, regularizers: Losses, count: int, offset: Tensor | None
    ) -> tuple[list[Tensor | None], list[list[FactoredTerm]]]:
        """Differentiate losses by all tensors, and by the offset of the centres, whose gradient stays with it.

        Regularizers count as means over `count` frames.
        """
        inputs = [*self.tensors, *([] if offset is None else [offset])]
        derivatives = [own_derivative(loss) for loss in losses.values()]
        derivatives += [_share(count, loss.dtype, loss.device) for loss in regularizers.values()]
        roots = [*losses.values(), *regularizers.values()]
        found: list[Tensor | None] = [*torch.autograd.grad(roots, inputs, derivatives, allow_unused=True)]
        if offset is not None:
            offset.grad = found.pop()
        return found, [own.take() for own in self.factored]


@cache
def _share(count: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, ""]:
    return torch.full((), 1 / count, dtype=dtype, device=device)


@contextmanager
def threads_of_frames(like: Tensor) -> Iterator[Map]:
    """Threads that end with the block, one for each core, each of which keeps to its own. A GPU has one for all."""
    count = _native.thread_count() if like.is_cpu else 1
    if count == 1:
        yield lambda calls: [call() for call in calls]
        return

    def begin() -> None:
        torch.set_num_threads(1)  # torch limits the threads of its operations for each thread apart
        _native.keep_loops_serial(True)

    with ThreadPoolExecutor(count, thread_name_prefix="mien-frames", initializer=begin) as pool:

        def together(calls: Items[Callable[[], Part]]) -> list[Part]:
            waiting = [pool.submit(call) for call in calls]
            return [one.result() for one in waiting]

        yield together


def frames_apart(
    state: TrainingState, batch: Items[BatchFrame], progress: Progress, groups: Items[ParameterGroup], each: Map
) -> list[Part]:
    """The frames of a step, and its side view if it has one. Tensors and factored gradients have their gradients.

    Losses of pictures and those of the method are means over the frames.
    """
    trained = _Trained.of(groups)
    calls = [partial(_frame, state, one, progress, len(batch), trained) for one in batch]
    if state.head is not None and state.head.has_view:
        calls.append(partial(_side_view, state, progress, trained))
    parts = each(calls)
    total = parts[0].gradients
    for part in parts[1:]:
        total = _added(total, part.gradients)
    for tensor, gradient in zip(trained.tensors, total, strict=True):
        tensor.grad = gradient
    for index, factored in enumerate(trained.factored):
        factored.terms.extend(term for part in parts for term in part.terms[index])
    return parts


def _added(first: Items[Tensor | None], second: Items[Tensor | None]) -> list[Tensor | None]:
    pairs = list(zip(first, second, strict=True))
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    found = iter(sums([a for a, _ in both], [b for _, b in both]))
    return [next(found) if a is not None and b is not None else b if a is None else a for a, b in pairs]


def _frame(state: TrainingState, one: BatchFrame, progress: Progress, count: int, trained: _Trained) -> Part:
    whole, (posed,), (rendering,) = draw(state, [one], progress)
    (shown,) = seen(state, [one], [rendering])
    losses = compare(state, [one], [shown], count) | compare_features(state, [one], [shown], count)
    regularizers = state.avatar.regularizers(whole, rendering, progress)
    gradients, terms = trained.by(losses, regularizers, count, rendering.means2d_offset)
    # Density control sums lengths of gradients over frames, as if each were alone.
    assert rendering.means2d_offset.grad is not None
    rendering.means2d_offset.grad *= count
    return Part(losses, gradients, terms, regularizers, posed, rendering, shown)


def _side_view(state: TrainingState, progress: Progress, trained: _Trained) -> Part:
    assert state.head is not None
    losses = state.head.losses(progress)
    return Part(losses, *trained.by(losses, {}, 1, None))


def summed(parts: Items[Part], count: int) -> Losses:
    """The losses of a step with `count` frames, by name."""
    total: Losses = {}
    for part in parts:
        own = part.losses | {name: loss / count for name, loss in part.regularizers.items()}
        for name, loss in own.items():
            total[name] = total[name] + loss.detach() if name in total else loss.detach()
    return total
