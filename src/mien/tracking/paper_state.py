"""The state of a fit of the `paper` schedule as named tensors, from which an interrupted fit resumes."""

import torch
from torch import Tensor

from mien.tracking.paper_adam import Moments, RowStepper
from mien.tracking.paper_scene import PaperState


def pack(
    state: PaperState,
    moments: dict[str, Moments],
    steppers: dict[tuple[int, int], RowStepper],
    lost: list[tuple[int, int]],
    done: int,
) -> dict[str, Tensor]:
    """The complete state of a fit as tensors by name."""
    tensors = state.tensors() | {"done": torch.tensor([done]), "lost": torch.tensor(lost).reshape(-1, 2)}
    every = {f"moments/{name}": own for name, own in moments.items()}
    every |= {f"rows/{sequence}/{row}": own.moments for (sequence, row), own in steppers.items()}
    for name, own in every.items():
        tensors |= {f"{name}/first": own.first, f"{name}/second": own.second, f"{name}/count": torch.tensor(own.count)}
    return tensors | {f"rows/{sequence}/{row}/whitening": own.whitening for (sequence, row), own in steppers.items()}


def unpack_state(state: PaperState, tensors: dict[str, Tensor]) -> None:
    """Copy the tensors into a state of the same sizes, in place."""
    for name, tensor in state.tensors().items():
        tensor.copy_(tensors[name])


def unpack_moments(tensors: dict[str, Tensor], prefix: str) -> dict[str, Moments]:
    """The moments whose names begin with a prefix, by the rest of their names."""
    names = {name[len(prefix) :].rsplit("/", 1)[0] for name in tensors if name.startswith(prefix)}
    return {
        name: Moments(
            tensors[f"{prefix}{name}/first"], tensors[f"{prefix}{name}/second"],
            int(tensors[f"{prefix}{name}/count"]),
        )
        for name in sorted(names)
    }  # fmt: skip
