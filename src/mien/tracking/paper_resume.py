"""What an interrupted `paper` fit goes on from: one file, written now and then."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from mien.errors import UserError
from mien.progress import say
from mien.storage import read_tensors, write_tensors
from mien.tracking.paper_adam import Moments, RowStepper
from mien.tracking.paper_scene import PaperState

_INTERVAL_SECONDS = 20.0


@dataclass(eq=False)
class Keeper:
    """Writes a fit's state into a file, at most every 20 seconds; nowhere if there is no file. Mutable."""

    path: Path | None
    last: float = field(default_factory=time.monotonic)

    def offer(self, tensors: dict[str, Tensor]) -> None:
        """Write them, unless the last time is not long ago."""
        if self.path is not None and time.monotonic() - self.last >= _INTERVAL_SECONDS:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_tensors(self.path, tensors)
            self.last = time.monotonic()

    def read(self) -> dict[str, Tensor] | None:
        """What was written last, if it can be read."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            # Copies lie where new tensors lie: matrix products take other paths where memory is aligned otherwise.
            return {name: tensor.clone() for name, tensor in read_tensors(self.path).items()}
        except UserError:
            say(f"{self.path.name}: damaged, so the fit to pixels starts anew")
            return None

    def forget(self) -> None:
        """The fit is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def pack(
    state: PaperState,
    moments: dict[str, Moments],
    steppers: dict[tuple[int, int], RowStepper],
    lost: list[tuple[int, int]],
    done: int,
) -> dict[str, Tensor]:
    """Everything that a fit goes on from, by name."""
    tensors = state.tensors() | {"done": torch.tensor([done]), "lost": torch.tensor(lost).reshape(-1, 2)}
    every = {f"moments/{name}": own for name, own in moments.items()}
    every |= {f"rows/{sequence}/{row}": own.moments for (sequence, row), own in steppers.items()}
    for name, own in every.items():
        tensors |= {f"{name}/first": own.first, f"{name}/second": own.second, f"{name}/count": torch.tensor(own.count)}
    return tensors | {f"rows/{sequence}/{row}/whitening": own.whitening for (sequence, row), own in steppers.items()}


def unpack_state(state: PaperState, tensors: dict[str, Tensor]) -> None:
    """Fill in a state of the same sizes, in place."""
    for name, tensor in state.tensors().items():
        tensor.copy_(tensors[name])


def unpack_moments(tensors: dict[str, Tensor], prefix: str) -> dict[str, Moments]:
    """Moments whose names begin with a prefix, by the rest of their names."""
    names = {name[len(prefix) :].rsplit("/", 1)[0] for name in tensors if name.startswith(prefix)}
    return {
        name: Moments(
            tensors[f"{prefix}{name}/first"], tensors[f"{prefix}{name}/second"],
            int(tensors[f"{prefix}{name}/count"]),
        )
        for name in sorted(names)
    }  # fmt: skip
