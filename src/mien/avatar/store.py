"""GaussianStore: all per-Gaussian tensors with their optimiser state, so that density control treats all alike."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor, nn

from mien.adam import FactoredMoments, Moments


def as_array(tensor: Tensor) -> Shaped[np.ndarray, "..."]:
    """A copy of a tensor as a contiguous array: float32 for floating point, int32 for everything else."""
    return np.array(tensor.detach().cpu().numpy(), np.float32 if tensor.is_floating_point() else np.int32, order="C")


class GaussianStore(nn.Module):
    """n Gaussians as a dict of equally long tensors. Some are trained; others, such as triangle indices, are fixed.

    `select` and `append` replace the tensors: across density control, hold names and not tensors. The moments of
    trained tensors are here too and follow every change. New Gaussians start with zero moments.
    """

    def __init__(self, trained: Mapping[str, Tensor], fixed: Mapping[str, Tensor] | None = None):
        super().__init__()
        self.trained = nn.ParameterDict(
            {name: nn.Parameter(tensor.detach().clone()) for name, tensor in trained.items()}
        )
        self.fixed_names = tuple(fixed or ())
        for name, tensor in (fixed or {}).items():
            self.register_buffer(name, tensor.detach().clone())
        self.moments: dict[str, Moments | FactoredMoments] = {}
        lengths = {name: self[name].shape[0] for name in self.names()}
        assert len(set(lengths.values())) == 1, f"per-Gaussian tensors differ in length: {lengths}"

    def __len__(self) -> int:
        """The number of Gaussians, n."""
        return self[self.names()[0]].shape[0]

    def __getitem__(self, name: str) -> Tensor:
        """One per-Gaussian tensor with first axis n. A trained tensor is a leaf of the autograd graph."""
        # This bypasses torch's look-ups, which take ten times as long: a training step needs a dozen.
        fixed = self._buffers.get(name)
        return self._modules["trained"]._parameters[name] if fixed is None else fixed  # pyright: ignore

    def names(self) -> tuple[str, ...]:
        """Names of all tensors, trained ones first."""
        return (*self.trained.keys(), *self.fixed_names)

    def arrays(self) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Copies of all tensors for records of `mien.runtime`."""
        return {name: as_array(self[name]) for name in self.names()}

    def select(self, kept: Tensor) -> None:
        """Keep only the Gaussians that a bool mask [n] selects, or those at the given indices, in that order."""
        kept = kept.nonzero()[:, 0] if kept.dtype == torch.bool else kept
        self._replace({name: self[name].detach()[kept] for name in self.names()})
        for state in self.moments.values():
            for field in state.PER_ROW:
                setattr(state, field, getattr(state, field)[kept])

    def append(self, parents: Tensor, overrides: Mapping[str, Tensor] | None = None) -> None:
        """Add one child for each index in `parents` [c]: a copy of its parent except for the tensors in `overrides`."""
        overrides = overrides or {}
        unknown = set(overrides) - set(self.names())
        assert not unknown, f"no such per-Gaussian tensors: {unknown}"
        grown = {}
        for name in self.names():
            own = self[name].detach()
            grown[name] = torch.cat([own, overrides[name].detach().to(own) if name in overrides else own[parents]])
        self._replace(grown)
        for state in self.moments.values():
            for field in state.PER_ROW:
                own = getattr(state, field)
                setattr(state, field, torch.cat([own, own.new_zeros((parents.shape[0], *own.shape[1:]))]))

    def assign(self, name: str, value: Tensor) -> None:
        """Overwrite a tensor outside the optimiser, as an opacity reset does. Its moments restart from zero."""
        with torch.no_grad():
            self[name].copy_(value)
        if name in self.moments:
            state = self.moments[name]
            for field in state.PER_ROW:
                setattr(state, field, torch.zeros_like(getattr(state, field)))

    def assign_rows(self, name: str, rows: Int[Tensor, " k"], values: Tensor) -> None:
        """Overwrite some rows of a tensor outside the optimiser. Only their moments restart from zero."""
        with torch.no_grad():
            self[name].index_copy_(0, rows, values.to(self[name]))
        if name in self.moments:
            state = self.moments[name]
            for field in state.PER_ROW:
                getattr(state, field).index_fill_(0, rows, 0.0)

    def resize(self, length: int) -> None:
        """Make room for `length` Gaussians whose values will be loaded next. Moments are dropped."""
        self.moments = {}
        self.select(torch.zeros(length, dtype=torch.long, device=self[self.names()[0]].device))

    def _replace(self, tensors: dict[str, Tensor]) -> None:
        for name, tensor in tensors.items():
            if name in self.trained:
                self.trained[name] = nn.Parameter(tensor)
            else:
                self.register_buffer(name, tensor)
