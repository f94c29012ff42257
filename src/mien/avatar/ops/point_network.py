"""A small dense network, the same for many points, whose layers may read an earlier layer a second time.

All networks of MonoGaussianAvatar have this form. The activation softplus has a sharpness of 100, as published.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import native, recycled, recycled_like, unpacked

SHARPNESS = 100.0
"""Sharpness of the softplus: ln(1 + exp(100 x)) / 100."""
Activation = Literal["none", "relu", "softplus"]
CODES: dict[Activation, int] = {"none": 0, "relu": 1, "softplus": 2}
_LANES = 16


class Layer(NamedTuple):
    """One layer: activation(weight [values, extra values] + bias)."""

    weight: Float[Tensor, "o i"]
    bias: Float[Tensor, " o"]
    activation: Activation = "none"
    extra: int | None = None
    """Whose values are read after those of the previous layer: 0 for the inputs, 1 for the first layer, and so on."""


class Rows(NamedTuple):
    """Rows of a layer: a linear layer, with weight normalisation or without, that reads the inputs from a column on."""

    linear: nn.Linear
    column: int = 0


class PlannedLayer(NamedTuple):
    """A layer whose weights come from parameters of modules. The other fields are as in `Layer`."""

    rows: Sequence[Rows]
    activation: Activation = "none"
    extra: int | None = None
    scale: float = 1.0
    """Factor on the weights, but not on the bias."""


def point_network_reference(inputs: Float[Tensor, "n i"], layers: Sequence[Layer]) -> Float[Tensor, "n o"]:
    """`point_network` in plain PyTorch."""
    values = [inputs]
    for layer in layers:
        read = values[-1] if layer.extra is None else torch.cat([values[-1], values[layer.extra]], dim=-1)
        values.append(_ACTIVATIONS[layer.activation](torch.addmm(layer.bias, read, layer.weight.T)))
    return values[-1]


@native(point_network_reference)
def point_network(inputs: Float[Tensor, "n i"], layers: Sequence[Layer]) -> Float[Tensor, "n o"]:
    """The outputs of the last layer, which has no activation. Differentiable in inputs, weights and biases.

    Native for float32 on a CPU: one call forward and one backward, which skips points without gradients. The result
    does not depend on the number of threads.
    """
    structure = tuple((CODES[layer.activation], -1 if layer.extra is None else layer.extra) for layer in layers)
    return _PointNetwork.apply(structure, inputs, *(tensor for layer in layers for tensor in layer[:2]))


_ACTIVATIONS = {
    "none": lambda values: values,
    "relu": torch.relu,
    "softplus": lambda values: torch.nn.functional.softplus(values, beta=SHARPNESS),
}


class _PointNetwork(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, structure: tuple[tuple[int, int], ...], inputs: Tensor, *parameters: Tensor) -> Tensor:
        points, *own = [tensor.contiguous() for tensor in (inputs, *parameters)]
        outputs, kept = recycled(len(points), len(own[-1])), None
        if any(ctx.needs_input_grad):
            kept = recycled(len(points), sum(-(-len(bias) // _LANES) * _LANES for bias in own[1:-1:2]))
        plain = unpacked(points, kept, outputs)
        _native.point_network(_layers(structure, own), plain[0], plain[1], plain[2])
        ctx.structure = structure
        ctx.save_for_backward(points, *own, *([] if kept is None else [kept]))
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_outputs: Tensor) -> tuple[Tensor | None, ...]:
        points, *own, kept = ctx.saved_tensors
        by_points = recycled_like(points) if ctx.needs_input_grad[1] else None
        gradients = [recycled_like(tensor) for tensor in own]
        plain = unpacked(points, kept, by_outputs.contiguous(), by_points)
        into = [_native.PointLayerGradients(*unpacked(*pair)) for pair in _pairs(gradients)]
        _native.point_network_backward(
            _layers(ctx.structure, own), plain[0], plain[1], plain[2], into, by_inputs=plain[3]
        )
        return None, by_points, *gradients


def _layers(structure: tuple[tuple[int, int], ...], parameters: Sequence[Tensor]) -> list[Any]:
    layers = []
    for (weight, bias), (activation, extra) in zip(_pairs(parameters), structure, strict=True):
        plain = unpacked(weight, bias)
        layers.append(_native.PointLayer(plain[0], plain[1], activation, extra))
    return layers


def _pairs(tensors: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    return list(zip(tensors[::2], tensors[1::2], strict=True))
