"""A small dense network, the same for many points, whose layers may read an earlier layer a second time.

All networks of MonoGaussianAvatar have this form. The activation softplus has a sharpness of 100, as published.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

SHARPNESS = 100.0
"""Sharpness of the softplus: ln(1 + exp(100 x)) / 100."""
Activation = Literal["none", "relu", "softplus"]


class Layer(NamedTuple):
    """One layer: activation(weight [values, extra values] + bias)."""

    weight: Float[Tensor, "o i"]
    bias: Float[Tensor, " o"]
    activation: Activation = "none"
    extra: int | None = None
    """Whose values are read after those of the previous layer: 0 for the inputs, 1 for the first layer, and so on."""


def point_network(inputs: Float[Tensor, "n i"], layers: Sequence[Layer]) -> Float[Tensor, "n o"]:
    """The outputs of the last layer, differentiable in inputs, weights and biases."""
    return point_network_reference(inputs, layers)


def point_network_reference(inputs: Float[Tensor, "n i"], layers: Sequence[Layer]) -> Float[Tensor, "n o"]:
    """`point_network` in plain PyTorch."""
    values = [inputs]
    for layer in layers:
        read = values[-1] if layer.extra is None else torch.cat([values[-1], values[layer.extra]], dim=-1)
        values.append(_ACTIVATIONS[layer.activation](torch.addmm(layer.bias, read, layer.weight.T)))
    return values[-1]


_ACTIVATIONS = {
    "none": lambda values: values,
    "relu": torch.relu,
    "softplus": lambda values: torch.nn.functional.softplus(values, beta=SHARPNESS),
}
