"""Adam over parameter groups. Its state is accessible to density control and checkpoints."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mien import _native
from mien.adam import BETA1, BETA2
from mien.arrays import unpacked
from mien.avatar import Moments, ParameterGroup, Progress

_EPSILON = 1e-15


class Update(NamedTuple):
    """The change of one tensor in one step."""

    values: Tensor
    gradient: Tensor
    moments: Moments
    rate: float


class Adam:
    """Adam (Kingma and Ba 2015) with the constants of 3D Gaussian Splatting. One native call updates all tensors.

    The state of per-Gaussian tensors is in their store, that of networks is here.
    """

    def __init__(self) -> None:
        self._moments: dict[str, dict[str, Moments]] = {}

    def step(self, groups: Iterable[ParameterGroup], progress: Progress) -> None:
        """Update every tensor that has a gradient, at its group's rate, and clear the gradients."""
        updates: list[Update] = []
        for group in groups:
            rate = group.rate_at(progress)
            for name, tensor in group.tensors.items():
                gradient = tensor.grad
                if gradient is None:
                    continue
                tensor.grad = None
                if rate > 0:
                    updates.append(Update(tensor, gradient, self._state(group, name, tensor), rate))
        update_all(updates)

    def state(self) -> dict[str, Moments]:
        """The state of all tensors that have no store, by group and tensor."""
        return {f"{group}/{name}": state for group, own in self._moments.items() for name, state in own.items()}

    def load_state(self, state: Mapping[str, Moments]) -> None:
        """Restore what `state` returned."""
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
    """Apply all updates in place: natively if tensors are float32, contiguous and on a CPU."""
    tasks = []
    for update in updates:
        task = _native_task(update)
        if task is None:
            update_reference(update)
        else:
            tasks.append(task)
    if tasks:
        _native.adam_update(tasks)


@torch.no_grad()
def update_reference(update: Update) -> None:
    """One update in plain PyTorch."""
    values, gradient, moments, rate = update
    moments.step += 1
    step = float(moments.step)
    moments.first.lerp_(gradient, 1 - BETA1)
    moments.second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    denominator = moments.second.sqrt().mul_(1 / math.sqrt(1 - BETA2**step)).add_(_EPSILON)
    values.addcdiv_(moments.first, denominator, value=-rate / (1 - BETA1**step))


def _native_task(update: Update) -> tuple[Any, Any, Any, Any, Any, float] | None:
    """The update in the form that the core takes, or None if it cannot take these tensors."""
    values, gradient, moments, rate = update
    arrays = (values, gradient, moments.first, moments.second, moments.step)
    for tensor in arrays:
        if not (tensor.is_cpu and tensor.dtype is torch.float32 and tensor.is_contiguous()):
            return None
    return *unpacked(*arrays), rate
