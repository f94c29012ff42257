"""Adam over parameter groups, with its state where density control and checkpoints can reach it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mien import _native
from mien.avatar import Moments, ParameterGroup, Progress

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


@dataclass(frozen=True, eq=False)
class Update:
    """What one step does to one tensor."""

    values: Tensor
    gradient: Tensor
    moments: Moments
    rate: float


class Adam:
    """Adam (Kingma and Ba 2015) with the constants of 3D Gaussian Splatting; all tensors in one native call.

    The state of per-Gaussian tensors lives in their store, that of networks here.
    """

    def __init__(self) -> None:
        self._moments: dict[str, dict[str, Moments]] = {}

    def step(self, groups: Iterable[ParameterGroup], progress: Progress) -> None:
        """One update of every tensor that has a gradient, at the group's rate; clears the gradients."""
        updates: list[Update] = []
        for group in groups:
            rate = group.rate.at(progress)
            for name, tensor in group.tensors.items():
                if tensor.grad is not None and rate > 0:
                    updates.append(Update(tensor.detach(), tensor.grad, self._state(group, name, tensor), rate))
                tensor.grad = None
        update_all(updates)

    def state(self) -> dict[str, Moments]:
        """The state of everything that has no store, by group and tensor."""
        return {f"{group}/{name}": state for group, own in self._moments.items() for name, state in own.items()}

    def load_state(self, state: Mapping[str, Moments]) -> None:
        """Go on from what `state` returned."""
        self._moments = {}
        for key, moments in state.items():
            group, name = key.split("/", 1)
            self._moments.setdefault(group, {})[name] = moments

    def _state(self, group: ParameterGroup, name: str, tensor: Tensor) -> Moments:
        own = self._moments.setdefault(group.name, {}) if group.moments is None else group.moments
        if name not in own:
            own[name] = Moments.zeros(tensor.detach())
        return own[name]


def update_all(updates: Sequence[Update]) -> None:
    """Apply all updates in place, natively where tensors are float32, dense and on a CPU."""
    tasks = []
    for update in updates:
        moments = update.moments
        moments.step += 1
        values, gradient, first, second = tensors = (update.values, update.gradient, moments.first, moments.second)
        if not all(t.dtype is torch.float32 and t.is_cpu and t.is_contiguous() for t in tensors):
            update_reference(update)
            continue
        same_shape = values.shape == gradient.shape == first.shape == second.shape
        assert same_shape, "a gradient and moments have their tensor's shape"
        pointers = [tensor.data_ptr() for tensor in tensors]
        tasks.append((*pointers, values.numel(), *_step_sizes(update)))
    if tasks:
        _native.adam_update(tasks)


def update_reference(update: Update) -> None:
    """One update in plain PyTorch; `moments.step` already counts it."""
    moments, gradient = update.moments, update.gradient
    step_size, second_unbiased = _step_sizes(update)
    moments.first.lerp_(gradient, 1 - _BETA1)
    moments.second.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
    update.values.addcdiv_(moments.first, moments.second.sqrt().mul_(second_unbiased).add_(_EPSILON), value=-step_size)


def _step_sizes(update: Update) -> tuple[float, float]:
    """Rate / (1 - beta1^t) and 1 / sqrt(1 - beta2^t)."""
    step = float(update.moments.step)
    return update.rate / (1 - _BETA1**step), 1 / math.sqrt(1 - _BETA2**step)
