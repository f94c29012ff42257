"""Conversion of tensors for the native core."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.dlpack import to_dlpack

from mien import _native
from mien.kernels import on_gpu

_Operation = TypeVar("_Operation", bound=Callable[..., Any])


def recycled(*shape: int) -> Tensor:
    """An uninitialised float32 tensor on the CPU. A large one gets memory that was in use before.

    The kernel clears fresh pages, and at 2048x2048 that takes longer than drawing the picture.
    """
    return _native.recycled(shape)


def recycled_like(tensor: Tensor) -> Tensor:
    """`recycled` with the shape of a tensor."""
    return _native.recycled(tensor.shape)


def recycled_twice(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Two tensors as that of `recycled` in the same memory: one to return from a forward pass, one to keep.

    What an operation of autograd returns has a history. If the operation kept it, it would keep itself.
    """
    return _native.recycled_twice(shape)


def is_native(*tensors: Tensor) -> bool:
    """Whether the native core can compute with these tensors: float32, or integers, on a CPU."""
    return all(
        tensor.device.type == "cpu" and (tensor.dtype is torch.float32 or not tensor.is_floating_point())
        for tensor in tensors
    )


def native(reference: Callable[..., Any], *, gpu: str | None = None) -> Callable[[_Operation], _Operation]:
    """Decorate an operation that calls the native core, so that `reference` computes what the core cannot take.

    Every native operation is dispatched in this way. `reference` is the same in plain PyTorch, for any dtype and
    device, and takes the same arguments. The tensors among them decide, but not those inside of records. `gpu` is the
    module with a function of the operation's name that calls kernels of a GPU; it is imported at its first use.
    """

    def decorate(operation: _Operation) -> _Operation:
        @wraps(operation)
        def dispatch(*arguments: Any, **named: Any) -> Any:
            tensors = [given for given in (*arguments, *named.values()) if isinstance(given, Tensor)]
            if gpu is not None and on_gpu(*tensors):
                return getattr(import_module(gpu), operation.__name__)(*arguments, **named)
            return (operation if is_native(*tensors) else reference)(*arguments, **named)

        return dispatch  # pyright: ignore[reportReturnType]

    return decorate


def unpacked(*tensors: Tensor | None) -> list[Any]:
    """CPU tensors in the form in which the core takes them, whether they need a gradient or not; None stays None.

    The core would otherwise call `__dlpack__` of each tensor itself. That takes ten times as long, 2 us, and happens a
    hundred times per training step. Use it only for functions with a single signature: each capsule can be consumed
    only once, so a second overload could not read it.
    """
    return [None if tensor is None else to_dlpack(tensor) for tensor in tensors]


@dataclass
class _Way:
    direct: bool = False


_WAY = _Way()


@contextmanager
def direct_gradients() -> Iterator[None]:
    """Let backward passes of the core give gradients to leaves themselves, for which PyTorch takes four operators each.

    It is for `torch.autograd.backward` alone: `torch.autograd.grad` would not get them.
    """
    _WAY.direct = True
    try:
        yield
    finally:
        _WAY.direct = False


def left_to_autograd(inputs: Sequence[Tensor | None], gradients: Sequence[Tensor | None]) -> list[Tensor | None]:
    """The gradients that PyTorch has to hand on: all, or within `direct_gradients` those of inputs that are no leaves.

    The other leaves get theirs.
    """
    left = list(gradients)
    for index, (leaf, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        if _WAY.direct and leaf is not None and gradient is not None and leaf.is_leaf and leaf.requires_grad:
            # The sum has memory of its own: a factored term may share that of the gradient before.
            leaf.grad = gradient if leaf.grad is None else leaf.grad + gradient
            left[index] = None
    return left


ONE = torch.ones(())
"""The tensor that `own_derivative` gives to all losses on the CPU."""


def own_derivative(loss: Float[Tensor, ""]) -> Tensor | None:
    """The derivative of a loss by itself; None where PyTorch is to make it."""
    return ONE if loss.dtype is torch.float32 and loss.device.type == "cpu" else None


def times(gradient: Tensor, factor: Float[Tensor, ""]) -> Tensor:
    """The gradient times a factor; itself if that is 1. It knows `ONE` without reading it."""
    return gradient if factor is ONE or float(factor) == 1 else gradient * factor


def sums(first: Sequence[Tensor], second: Sequence[Tensor]) -> list[Tensor]:
    """The sums of tensors of equal shapes, in memory of their own: one pass of the core for all that it can take."""
    if not is_native(*first, *second) or any(tensor.dtype != torch.float32 for tensor in first):
        return [a + b for a, b in zip(first, second, strict=True)]
    found = [recycled_like(tensor) for tensor in first]
    one, other = ([tensor.contiguous() for tensor in own] for own in (first, second))
    _native.add_arrays(unpacked(*one), unpacked(*other), unpacked(*found))
    return found


def clear_rows(chosen: Bool[Tensor, " n"], tensors: Sequence[Tensor]) -> None:
    """Set the chosen rows of all tensors [n, ...] to 0, in place. Native for float32 on a CPU, where torch is slow."""
    if is_native(*tensors, chosen) and all(tensor.is_contiguous() for tensor in tensors):
        (bytes_of_chosen,) = unpacked(chosen.view(torch.uint8))
        _native.clear_rows(bytes_of_chosen, unpacked(*tensors))
        return
    if on_gpu(*tensors, chosen) and all(tensor.is_contiguous() for tensor in tensors):
        import_module("mien.arrays_gpu").clear_rows(chosen, tensors)
        return
    for tensor in tensors:
        tensor.masked_fill_(chosen.view(-1, *[1] * (tensor.ndim - 1)), 0)
