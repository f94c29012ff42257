"""Tensors on their way into the native core."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.dlpack import to_dlpack

from mien import _native

_LARGE = 1 << 18
"""Numbers. Memory for fewer comes back from the allocator without fresh pages."""


def recycled(*shape: int) -> Tensor:
    """An uninitialised float32 tensor on the CPU; if it is large, its memory has been in use before.

    The kernel clears fresh pages, which at 2048x2048 takes longer than drawing the picture.
    """
    if math.prod(shape) < _LARGE:
        return torch.empty(shape)
    return _native.recycled(shape)


def unpacked(*tensors: Tensor | None) -> list[Any]:
    """What the core takes in place of CPU tensors that need no gradient; None stays None.

    The core would ask each tensor itself, by `__dlpack__`, which takes ten times as long: 2 us, a hundred times a
    training step. Only for functions of one signature: a second try finds what the first has taken.
    """
    return [None if tensor is None else to_dlpack(tensor) for tensor in tensors]
