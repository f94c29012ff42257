"""Tensors on their way into the native core."""

from typing import Any

from torch import Tensor
from torch.utils.dlpack import to_dlpack


def unpacked(*tensors: Tensor | None) -> list[Any]:
    """What the core takes in place of CPU tensors that need no gradient; None stays None.

    The core would ask each tensor itself, by `__dlpack__`, which takes ten times as long: 2 us, a hundred times a
    training step. Only for functions of one signature: a second try finds what the first has taken.
    """
    return [None if tensor is None else to_dlpack(tensor) for tensor in tensors]
