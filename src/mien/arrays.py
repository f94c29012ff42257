"""Conversion of tensors for the native core."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.utils.dlpack import to_dlpack

from mien import _native

_MIN_RECYCLED = 1 << 18
"""Smallest number of elements for which memory is recycled. Smaller blocks come back from the allocator without fresh
pages."""


def recycled(*shape: int) -> Tensor:
    """An uninitialised float32 tensor on the CPU. A large one gets memory that was in use before.

    The kernel clears fresh pages, and at 2048x2048 that takes longer than drawing the picture.
    """
    if math.prod(shape) < _MIN_RECYCLED:
        return torch.empty(shape)
    return _native.recycled(shape)


def unpacked(*tensors: Tensor | None) -> list[Any]:
    """CPU tensors that need no gradient, in the form in which the core takes them; None stays None.

    The core would otherwise call `__dlpack__` of each tensor itself. That takes ten times as long, 2 us, and happens a
    hundred times per training step. Use it only for functions with a single signature: each capsule can be consumed
    only once, so a second overload could not read it.
    """
    return [None if tensor is None else to_dlpack(tensor) for tensor in tensors]
