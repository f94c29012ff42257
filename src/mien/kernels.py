"""Kernels for a GPU, which are written in Triton. They come with PyTorch for CUDA, and are compiled at their first use.

Each file of kernels (`*_gpu.py`) is imported when the first tensor on a GPU needs it. Tensors on the device `meta`,
which have no values, take the same path: tests count the launches of a step with them. Triton's interpreter runs the
kernels on a processor (`TRITON_INTERPRET=1`), in any dtype.
"""

import os
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

VARIABLE = "MIEN_GPU_KERNELS"
"""If it is 0, a GPU computes all in plain PyTorch."""


def on_gpu(*tensors: Tensor) -> bool:
    """Whether kernels can compute with these tensors: float32, or integers, on a GPU with Triton."""
    return all(
        tensor.device.type in ("cuda", "meta") and (tensor.dtype is torch.float32 or not tensor.is_floating_point())
        for tensor in tensors
    ) and (bool(tensors) and os.environ.get(VARIABLE) != "0" and _has_triton())


def launch(kernel: Any, programs: int, *arguments: Any, **constants: Any) -> None:
    """Run a kernel in so many programs. On `meta`, one operation that has no effect stands for it."""
    if any(isinstance(one, Tensor) and one.is_meta for one in arguments):
        torch.zeros((), device="meta")
    elif programs > 0:
        kernel[(programs,)](*arguments, **constants)


def blocks(count: int, size: int) -> int:
    """The number of blocks of a size that hold `count` elements."""
    return -(-count // size)


@cache
def _has_triton() -> bool:
    return find_spec("triton") is not None
