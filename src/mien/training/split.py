"""Which timesteps are held out."""

import torch
from jaxtyping import Bool
from torch import Tensor

from mien.training.settings import Split

_BLOCK, _EVERY = 10, 5
_TAIL_SHARE = 0.2


def held_out(timesteps: int, split: Split) -> Bool[Tensor, " t"]:
    """Which of a sequence's timesteps are for testing.

    `blocks`: every fifth block of 10, beginning with the fifth, so that poses and expressions of the test are about
    those of training; clips of fewer than 50 have shorter blocks, so that they have a fifth one. `tail`: the last
    20 %, which may show what was never seen. `none`: nothing.
    """
    index = torch.arange(timesteps)
    if split == "blocks":
        block = min(_BLOCK, max(1, timesteps // _EVERY))
        return index // block % _EVERY == _EVERY - 1
    if split == "tail":
        return index >= timesteps - round(_TAIL_SHARE * timesteps)
    return torch.zeros(timesteps, dtype=torch.bool)
