"""Adam over parameter groups. Its state is accessible to density control and checkpoints."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.adam import BETA1, BETA2, EPSILON, FactoredMoments, FactoredTerm
from mien.arrays import unpacked
from mien.avatar.avatar import ParameterGroup
from mien.avatar.settings import Progress
from mien.avatar.store import Moments
from mien.kernels import on_gpu


class Update(NamedTuple):
    """The change of one tensor in one step."""

    values: Tensor
    gradient: Tensor
    moments: Moments
    rate: float
    epsilon: float = EPSILON
    """Added to the root of the second moment."""


class FactoredUpdate(NamedTuple):
    """The change of one tensor [n, k, f] in one step, by a sum of outer products."""

    values: Float[Tensor, "n k f"]
    terms: Sequence[FactoredTerm]
    moments: Moments | FactoredMoments
    """Of Adam as published, with two running means of every number, or one second moment for all k."""
    rate: float


class Adam:
    """Adam (Kingma and Ba 2015) with the constants of 3D Gaussian Splatting. One native call updates all tensors.

    A tensor with a factored gradient has an update of its own. The state of per-Gaussian tensors is in their store,
    that of networks is here.
    """

    def __init__(self) -> None:
        self._moments: dict[str, dict[str, Moments | FactoredMoments]] = {}

    def step(self, groups: Iterable[ParameterGroup], progress: Progress, frames: int = 1) -> None:
        """Update every tensor that has a gradient, at its group's rate, and clear the gradients.

        Gradients that are means over several `frames` decay as if the frames had come one after the other: to the power
        of their number (the rule of batches for Adam: Malladi et al., NeurIPS 2022; Grendel, ICLR 2025, has the same).
        """
        updates: list[Update] = []
        for group in groups:
            rate = group.rate_at(progress)
            for name, tensor in group.tensors.items():
                if name in group.factored:
                    terms = group.factored[name].take()
                    if terms and rate > 0:
                        state = self._state(group, name, tensor, group.factored_moments)
                        if on_gpu(tensor) and isinstance(state, Moments):
                            updates.append(Update(tensor, _whole(terms), state, rate))
                        else:
                            factored_update(FactoredUpdate(tensor, terms, state, rate))
                    continue
                gradient = tensor.grad
                if gradient is None:
                    continue
                tensor.grad = None
                if rate > 0:
                    state = self._state(group, name, tensor, Moments)
                    updates.append(Update(tensor, gradient, state, rate, group.epsilon))
        update_all(updates, frames)

    def state(self) -> dict[str, Moments | FactoredMoments]:
        """The state of all tensors that have no store, by group and tensor."""
        return {f"{group}/{name}": state for group, own in self._moments.items() for name, state in own.items()}

    def load_state(self, state: Mapping[str, Moments | FactoredMoments]) -> None:
        """Restore what `state` returned."""
        self._moments = {}
        for key, moments in state.items():
            group, name = key.split("/", 1)
            self._moments.setdefault(group, {})[name] = moments

    def _state(self, group: ParameterGroup, name: str, tensor: Tensor, kind: type[Any]) -> Any:
        own = self._moments.setdefault(group.name, {}) if group.moments is None else group.moments
        if name not in own:
            own[name] = kind.zeros(tensor.detach())
        state = own[name]
        assert isinstance(state, kind)
        return state


def update_all(updates: Sequence[Update], frames: int = 1) -> None:
    """Apply all updates in place: natively if tensors are float32, contiguous and on a CPU, with mien's `EPSILON`."""
    tasks, others = [], []
    for update in updates:
        values, gradient, moments, rate, epsilon = update
        arrays = (values, gradient, moments.first, moments.second, moments.step)
        if epsilon == EPSILON and _fit_core(arrays):
            tasks.append((*unpacked(*arrays), rate, frames))
        else:
            others.append(update)
    if tasks:
        _native.adam_update(tasks)
    if others:
        update_reference(*others, frames=frames)


@torch.no_grad()
def update_reference(*updates: Update, frames: int = 1) -> None:
    """Updates in plain PyTorch. Each operation takes all tensors at once, which are few launches on a GPU."""
    values, gradients, states, rates, epsilons = map(list, zip(*updates, strict=True))
    beta1, beta2 = BETA1**frames, BETA2**frames
    first, second = [moments.first for moments in states], [moments.second for moments in states]
    for moments in states:
        moments.step += 1
    steps = [float(moments.step) for moments in states]
    torch._foreach_lerp_(first, gradients, 1 - beta1)
    torch._foreach_mul_(second, beta2)
    torch._foreach_addcmul_(second, gradients, gradients, 1 - beta2)
    denominators = torch._foreach_sqrt(second)
    torch._foreach_mul_(denominators, [1 / math.sqrt(1 - beta2**step) for step in steps])
    torch._foreach_add_(denominators, epsilons)
    shares = [-rate / (1 - beta1**step) for rate, step in zip(rates, steps, strict=True)]
    torch._foreach_addcdiv_(values, first, denominators, shares)


def _fit_core(tensors: Iterable[Tensor]) -> bool:
    return all(tensor.is_cpu and tensor.dtype is torch.float32 and tensor.is_contiguous() for tensor in tensors)


def _whole(terms: Sequence[FactoredTerm]) -> Float[Tensor, "n k f"]:
    own = ((rows, columns if places is None else columns[places]) for rows, columns, places in terms)
    gradient = sum(rows[:, None, :] * columns[..., None] for rows, columns in own)
    assert isinstance(gradient, Tensor)
    return gradient


def factored_update(update: FactoredUpdate) -> None:
    """Apply an update in place: natively, without making the gradient, if tensors are float32, contiguous, on a CPU.

    With `FactoredMoments` it is Adam's without the running mean of the gradient, and with one second moment for all k:
    the running mean of the squared gradient's mean over k (the idea of Adafactor, Shazeer and Stern 2018). A row whose
    gradient is 0 keeps its values and its state, and a column that is 0 changes nothing. So the tensor is read and
    written once, where it changes, and its state is smaller by the number of columns.

    With `Moments` and one term, it has the bits of `update_all` with the whole gradient, which would be the largest
    tensor of a step. Only numbers below 1.2e-38 differ: they become 0, because running means that fade would be slow.
    """
    values, terms, moments, rate = update
    terms = [FactoredTerm(rows, torch.atleast_2d(columns.data), places) for rows, columns, places in terms]
    factored = isinstance(moments, FactoredMoments)
    state = (moments.second, moments.weights) if factored else (moments.first, moments.second, moments.step)
    arrays = (values.data, *state)
    if _fit_core((*arrays, *(tensor for term in terms for tensor in (term.rows, term.columns)))):
        native_values, *native_state = unpacked(*arrays)
        factors = (list(unpacked(*side)) for side in zip(*terms, strict=True))
        apply: Any = _native.factored_update if factored else _native.factored_adam_update
        apply(native_values, *factors, *native_state, rate)
    elif factored and on_gpu(values):
        from mien.training.training_gpu import factored_update as on_device

        on_device(values, terms, moments, rate)
    elif factored:
        factored_update_reference(update)
    else:
        with torch.no_grad():
            gradient = _whole(terms)
        update_reference(Update(values, gradient, moments, rate))


@torch.no_grad()
def factored_update_reference(update: FactoredUpdate) -> None:
    """`factored_update` with `FactoredMoments` in plain PyTorch, any number of terms, dtype and device."""
    values, terms, moments, rate = update
    assert isinstance(moments, FactoredMoments)
    gradient = _whole(terms)
    squares = gradient.square().mean(1)
    touched = (gradient != 0).flatten(1).any(1)
    # Selecting the touched rows would wait for a GPU to count them.
    second = moments.second * BETA2 + squares * (1 - BETA2)
    moments.second.copy_(torch.where(touched[:, None], second, moments.second))
    moments.weights.copy_(torch.where(touched, moments.weights * BETA2 + (1 - BETA2), moments.weights))
    weights = torch.where(touched, moments.weights, torch.ones_like(moments.weights))
    deviations = (moments.second / weights[:, None]).sqrt() + EPSILON
    values.sub_(rate * gradient / deviations[:, None])
