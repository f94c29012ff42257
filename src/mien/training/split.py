"""The split: which timesteps are held out."""

import torch
from jaxtyping import Bool
from torch import Tensor

from mien.training.settings import Split

_BLOCK, _EVERY = 10, 5
_TAIL_SHARE = 0.2


def held_out(timesteps: int, split: Split) -> Bool[Tensor, " t"]:
    """Which of a sequence's timesteps are held out for testing.

    `blocks`: every fifth block of 10, starting with the fifth, so that test poses and expressions resemble those of
        training. Clips of fewer than 50 timesteps have shorter blocks, so that they have a fifth one. `tail`: the last
        20 %, which may show things that were never seen. `none`: nothing.
    """
    index = torch.arange(timesteps)
    if split == "blocks":
        block = min(_BLOCK, max(1, timesteps // _EVERY))
        return index // block % _EVERY == _EVERY - 1
    if split == "tail":
        return index >= timesteps - round(_TAIL_SHARE * timesteps)
    return torch.zeros(timesteps, dtype=torch.bool)
