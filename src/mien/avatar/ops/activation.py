"""The sigmoid with the rounding of `mien.runtime`, so that pictures drawn without torch are identical to the bit."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import native, recycled_like, unpacked


@native(torch.sigmoid)
def sigmoid(values: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """1 / (1 + exp(-x)). Differentiable, and native for float32 on a CPU. NaN stays NaN."""
    return _Sigmoid.apply(values)  # pyright: ignore[reportReturnType]


class _Sigmoid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        values = values.contiguous()
        out = recycled_like(values)
        _native.sigmoid(*unpacked(values, out))
        ctx.save_for_backward(out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (out,) = ctx.saved_tensors
        result = recycled_like(out)
        _native.sigmoid_backward(*unpacked(out, gradient.contiguous(), result))
        return result
