"""Adam over parameter groups, with its state where density control and checkpoints can reach it."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

from mien.avatar import Moments, ParameterGroup, Progress

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


class Adam:
    """Adam (Kingma and Ba 2015) with the constants of 3D Gaussian Splatting; torch's fused kernel, one call a group.

    The state of per-Gaussian tensors lives in their store, that of networks here.
    """

    def __init__(self) -> None:
        self._moments: dict[str, dict[str, Moments]] = {}

    def step(self, groups: Iterable[ParameterGroup], progress: Progress) -> None:
        """One update of every tensor that has a gradient, at the group's rate; clears the gradients."""
        for group in groups:
            rate = group.rate.at(progress)
            trained = {name: tensor for name, tensor in group.tensors.items() if tensor.grad is not None}
            if rate > 0 and trained:
                states = self._states(group, trained)
                with torch.no_grad():
                    adam(
                        list(trained.values()),
                        [_gradient(tensor) for tensor in trained.values()],
                        [state.first for state in states],
                        [state.second for state in states],
                        [],
                        [state.step for state in states],
                        fused=True,
                        amsgrad=False,
                        beta1=_BETA1,
                        beta2=_BETA2,
                        lr=rate,
                        weight_decay=0.0,
                        eps=_EPSILON,
                        maximize=False,
                    )
            for tensor in trained.values():
                tensor.grad = None

    def state(self) -> dict[str, Moments]:
        """The state of everything that has no store, by group and tensor."""
        return {f"{group}/{name}": state for group, own in self._moments.items() for name, state in own.items()}

    def load_state(self, state: Mapping[str, Moments]) -> None:
        """Go on from what `state` returned."""
        self._moments = {}
        for key, moments in state.items():
            group, name = key.split("/", 1)
            self._moments.setdefault(group, {})[name] = moments

    def _states(self, group: ParameterGroup, trained: Mapping[str, Tensor]) -> list[Moments]:
        own = self._moments.setdefault(group.name, {}) if group.moments is None else group.moments
        for name, tensor in trained.items():
            if name not in own:
                own[name] = Moments.zeros(tensor.detach())
        return [own[name] for name in trained]


def _gradient(tensor: Tensor) -> Tensor:
    assert tensor.grad is not None
    return tensor.grad
