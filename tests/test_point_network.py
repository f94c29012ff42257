"""The network of points has the right softplus everywhere. tests/test_training_native.py compares it with its twin."""

import torch
from torch import Tensor

from mien.avatar.ops.point_network import Activation, Layer, point_network, point_network_reference
from toy_scene import random

Sizes = tuple[int, int, tuple[tuple[int, Activation, int | None], ...]]
"""Points, inputs, and outputs, activation and extra values of each layer."""
NETWORKS: list[Sizes] = [
    (100, 3, ((64, "softplus", None), (25, "softplus", None), (64, "softplus", 0), (11, "none", None))),
    (1, 1, ((1, "none", None),)),
    (0, 3, ((4, "relu", None), (5, "none", None))),
    (2000, 39, ((64, "softplus", None), (70, "relu", None), (17, "softplus", 1), (33, "none", 2))),
    (97, 3, ((16, "relu", None), (16, "softplus", 0), (5, "none", 0))),
]


def arguments(sizes: Sizes, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Inputs, then weight and bias of each layer. The values reach both ends of every activation."""
    n, inputs, layers = sizes
    widths, made = [inputs], [random(n, inputs)]
    for index, (outputs, _, extra) in enumerate(layers):
        reads = widths[-1] + (0 if extra is None else widths[extra])
        made += [random(outputs, reads, seed=2 * index + 1) / reads**0.5, 0.1 * random(outputs, seed=2 * index + 2)]
        widths.append(outputs)
    return [tensor.to(dtype) for tensor in made]


def layers_of(sizes: Sizes, parameters: list[Tensor]) -> list[Layer]:
    return [
        Layer(weight, bias, activation, extra)
        for weight, bias, (_, activation, extra) in zip(parameters[::2], parameters[1::2], sizes[2], strict=True)
    ]


def gradient_of(sizes: Sizes) -> Tensor:
    """A gradient of the outputs. Every third point has none."""
    gradient = random(sizes[0], sizes[2][-1][0], seed=99)
    gradient[::3] = 0
    return gradient


def results(sizes: Sizes, given: list[Tensor], native: bool) -> list[Tensor]:
    """Outputs, and gradients of inputs, weights and biases."""
    inputs, *parameters = [tensor.clone().requires_grad_() for tensor in given]
    outputs = (point_network if native else point_network_reference)(inputs, layers_of(sizes, parameters))
    found = torch.autograd.grad(outputs, [inputs, *parameters], gradient_of(sizes).to(outputs))
    return [tensor.detach() for tensor in (outputs, *found)]


def test_softplus_over_its_whole_range(isa: str) -> None:
    inputs = torch.cat([torch.linspace(-2, 2, 4001), torch.tensor([0.0, -1e30, 1e30, 1e-20])])[:, None]
    inputs, one = inputs.requires_grad_(), torch.ones(1, 1)
    outputs = point_network(inputs, [Layer(one, torch.zeros(1), "softplus"), Layer(one, torch.zeros(1))])
    (slope,) = torch.autograd.grad(outputs.sum(), inputs)
    expected = torch.nn.functional.softplus(inputs.double(), beta=100)
    torch.testing.assert_close(outputs.double(), expected, atol=2e-8, rtol=1e-6)
    torch.testing.assert_close(slope.double(), (100 * inputs.double()).sigmoid(), atol=2e-5, rtol=0)
