"""The three networks of MonoGaussianAvatar: attributes at rest, deformation of points, change of attributes.

Their inputs and outputs that are lengths are in units of `LENGTH_UNIT`. Each is a list of `Layer`, made anew from its
parameters for every step: linear layers that follow each other are multiplied first, which changes nothing but the
speed. Trunks have weight normalisation. With `every`, all layers have, and all but the last are followed by an
activation, as in figures 14 and 15 of the supplement.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.nn.utils.parametrizations import weight_norm

from mien.avatar.mono_gaussian_avatar.settings import WeightNorm
from mien.avatar.ops.point_network import Activation, Layer, PlannedLayer, Rows, point_network
from mien.avatar.ops.points import positional_encoding
from mien.kernels import on_gpu

SKINNING_SHARPNESS = 20.0
"""Factor on the logits of the skinning weights: their softmax has a temperature of 1/20. As published."""
_SPHERE_RADIUS = 0.6  # radius of the sphere whose distance a network gives at the start. As published

_SKIP = 3  # the layer, counted from 0, that reads the encoding again

ATTRIBUTES = ("log_scales", "quats", "opacity_logits", "sh")
"""Outputs of the attribute networks, in the order of their columns."""
ATTRIBUTE_WIDTHS = (3, 4, 1, 3)
"""Number of columns of each output. Colours and scales go through a sigmoid: `log_scales` and `sh` are logits."""


class AttributeNet(nn.Module):
    """Raw attributes of a point at rest, given its position.

    With `sphere`, the trunk starts as about the signed distance to a sphere, as published.
    """

    def __init__(self, width: int, layers: int, bands: int, sphere: bool = True, every: bool = False):
        super().__init__()
        self.bands, self.every = bands, every
        inputs = 3 + 6 * bands
        # The encoding enters a second time after the third layer, which has fewer outputs to make room for it.
        self.skip = _SKIP if layers > _SKIP and width > inputs else None
        sizes = [inputs, *[width] * layers]
        outputs = [size - inputs if index + 1 == self.skip else size for index, size in enumerate(sizes[1:])]
        plain = [_linear(i, o) for i, o in zip(sizes[:-1], outputs, strict=True)]
        with torch.no_grad():
            # Start with smooth functions of the position. The waves of the encoding come in as training needs them.
            plain[0].weight[:, 3:] = 0
            if self.skip is not None:
                plain[self.skip].weight[:, width - inputs + 3 :] = 0
            if sphere:
                nn.init.normal_(plain[-1].weight, math.sqrt(math.pi / width), 1e-4)
                nn.init.constant_(plain[-1].bias, -_SPHERE_RADIUS)
        # Last, so that the norms are those of the weights above.
        self.trunk = nn.ModuleList(weight_norm(layer) for layer in plain)
        self.heads = nn.ModuleList(_normed(nn.Linear(width, width), every) for _ in ATTRIBUTE_WIDTHS)
        self.color = _normed(nn.Linear(width, width), every)
        self.outputs = nn.ModuleList(_normed(nn.Linear(width, size), every) for size in ATTRIBUTE_WIDTHS)
        with torch.no_grad():
            _as_linear(self.outputs[1]).bias.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))

    def layers(self) -> list[Layer]:
        """The layers that follow the encoding. Where the colour's second layer is linear, it joins the one after it."""
        layers = []
        for index, layer in enumerate(self.trunk):
            weight, bias = _as_linear(layer).weight, _as_linear(layer).bias
            if index == self.skip:
                layers.append(Layer(weight / math.sqrt(2), bias, "softplus", extra=0))
            else:
                layers.append(Layer(weight, bias, "softplus"))
        layers.append(_beside([_as_linear(head) for head in self.heads], "softplus"))
        *others, last = [(_as_linear(output).weight, _as_linear(output).bias) for output in self.outputs]
        weight, bias = self.color.weight, self.color.bias
        if not self.every:
            return [*layers, _block_diagonal([*others, (last[0] @ weight, last[0] @ bias + last[1])])]
        # The second layer reads the colour's head, the last one reads this layer for the colour, and the other heads.
        own, rows = _block_diagonal(others), sum(ATTRIBUTE_WIDTHS[:-1])
        read = [pad(last[0], (0, 0, rows, 0)), pad(own.weight, (0, len(bias), 0, len(last[1])))]
        second = Layer(pad(weight, (len(others) * len(bias), 0)), bias, "softplus")
        return [*layers, second, Layer(torch.cat(read, dim=1), torch.cat([own.bias, last[1]]), extra=len(layers))]

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 11"]:
        """Columns as in `ATTRIBUTES`."""
        encoded = positional_encoding(points, self.bands)
        return _on_gpu(encoded, self.plan()) if on_gpu(points) else point_network(encoded, self.layers())

    def plan(self) -> list[PlannedLayer]:
        """The same layers for a GPU, which multiplies none."""
        plan = [PlannedLayer([Rows(_as_linear(layer))], "softplus") for layer in self.trunk]
        if self.skip is not None:
            plan[self.skip] = plan[self.skip]._replace(extra=0, scale=1 / math.sqrt(2))
        heads = [Rows(_as_linear(head)) for head in self.heads]
        color, width = _as_linear(self.color), self.color.out_features
        second = Rows(color, (len(heads) - 1) * width)
        # The last layer reads the second layer of the colour, and after it the heads.
        last = [Rows(_as_linear(output), (1 + index) * width) for index, output in enumerate(self.outputs)]
        last[-1] = Rows(last[-1].linear)
        plan += [PlannedLayer(heads, "softplus"), PlannedLayer([second], "softplus" if self.every else "none")]
        return [*plan, PlannedLayer(last, extra=len(plan) - 1)]


class Deformation(NamedTuple):
    """What the deformation network says about points."""

    offset: Float[Tensor, "n 3"]
    """O: the canonical position less the point's own."""
    expression: Float[Tensor, "n 3 e"]
    pose: Float[Tensor, "n 3 p"]
    weights: Float[Tensor, "n k"]
    """Skinning weights, which sum to 1."""


class DeformationNet(nn.Module):
    """Offset, blend directions and skinning weights of a point, given its position. At first zero, zero, equal.

    In the form `code`, the hidden layer of the skinning weights also has weight normalisation, in `paper` all layers.
    """

    def __init__(self, width: int, expressions: int, pose_features: int, bones: int, form: WeightNorm = "trunks"):
        super().__init__()
        self.expressions, self.pose_features = expressions, pose_features
        self.trunk = nn.ModuleList(weight_norm(_linear(size, width)) for size in (3, width, width, width))
        self.directions = nn.Linear(width, 3 * (1 + expressions + pose_features))
        self.hidden = nn.Linear(width, width) if form == "trunks" else weight_norm(_linear(width, width))
        self.skinning = nn.Linear(width, bones)
        for last in (self.directions, self.skinning):
            # A weight of 0 has no direction, so only its length is 0 at first.
            length = "parametrizations.weight.original0" if form == "paper" else "weight"
            nn.init.zeros_(_normed(last, form == "paper").get_parameter(length))
            nn.init.zeros_(last.bias)

    def forward(
        self, points: Float[Tensor, "n 3"], coefficients: Float[Tensor, "b c"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "b n 3"], Float[Tensor, "n k"]]:
        """Offsets, sums of directions weighted by `coefficients`, and skinning weights.

        The layer of directions is linear, so its weights are summed in place of the directions: exactly the same sums
        for a fraction of the work.
        """
        weight, bias = self._directions()
        weight = torch.cat([weight[:, 0], torch.einsum("bc,xcw->bxw", coefficients, weight[:, 1:]).flatten(0, 1)])
        bias = torch.cat([bias[:, 0], torch.einsum("bc,xc->bx", coefficients, bias[:, 1:]).flatten()])
        outputs = point_network(points, self._layers(weight, bias))
        offset, moved, logits = outputs.split([3, 3 * len(coefficients), self.skinning.out_features], dim=-1)
        moved = moved.unflatten(-1, (-1, 3)).transpose(0, 1)
        return offset, moved, (SKINNING_SHARPNESS * logits).softmax(-1)

    def outputs(self, points: Float[Tensor, "n 3"], coefficients: Float[Tensor, "b c"] | None = None) -> Tensor:
        """Offsets, sums of directions, and logits of skinning weights of points on a GPU.

        Without coefficients, each number of an offset and its directions lie side by side.
        """
        from mien.avatar.ops.point_network_gpu import packed, packed_network, structure_of, summed_directions

        plan = self.plan()
        structure = structure_of(3, plan)
        parameters = packed(plan, structure)
        if coefficients is not None:
            parameters, structure = summed_directions(parameters, coefficients, structure)
        return packed_network(points, parameters, structure)

    def plan(self) -> list[PlannedLayer]:
        """The layers of `whole` for a GPU."""
        trunk = [PlannedLayer([Rows(_as_linear(layer))], "softplus") for layer in self.trunk]
        last = [Rows(self.directions, _as_linear(self.hidden).out_features), Rows(self.skinning)]
        return [*trunk, PlannedLayer([Rows(_as_linear(self.hidden))], "softplus"), PlannedLayer(last, extra=len(trunk))]

    def whole(self, points: Float[Tensor, "n 3"]) -> Deformation:
        """Everything about some points, with every direction."""
        weight, bias = self._directions()
        widths = [1, self.expressions, self.pose_features]
        outputs = point_network(points, self._layers(weight.flatten(0, 1), bias.flatten()))
        directions, logits = outputs.split([3 * sum(widths), self.skinning.out_features], dim=-1)
        offset, expression, pose = directions.unflatten(-1, (3, -1)).split(widths, dim=-1)
        return Deformation(offset[..., 0], expression, pose, (SKINNING_SHARPNESS * logits).softmax(-1))

    def _directions(self) -> tuple[Float[Tensor, "3 _ w"], Float[Tensor, "3 _"]]:
        return self.directions.weight.unflatten(0, (3, -1)), self.directions.bias.unflatten(0, (3, -1))

    def _layers(self, weight: Float[Tensor, "o w"], bias: Float[Tensor, " o"]) -> list[Layer]:
        """Trunk, hidden layer of the skinning weights, and their logits beside `weight` and `bias` of the trunk."""
        trunk = [Layer(_as_linear(layer).weight, _as_linear(layer).bias, "softplus") for layer in self.trunk]
        hidden = Layer(_as_linear(self.hidden).weight, _as_linear(self.hidden).bias, "softplus")
        of_hidden = torch.cat([weight.new_zeros(weight.shape), self.skinning.weight])
        of_trunk = torch.cat([weight, weight.new_zeros(self.skinning.weight.shape)])
        last = Layer(torch.cat([of_hidden, of_trunk], dim=1), torch.cat([bias, self.skinning.bias]), extra=len(trunk))
        return [*trunk, hidden, last]


class AttributeChangeNet(nn.Module):
    """Changes of a point's raw attributes, given its motion from the canonical position."""

    def __init__(self, width: int, every: bool = False):
        super().__init__()
        self.every = every
        self.trunk = nn.ModuleList(weight_norm(nn.Linear(size, width)) for size in (3, width, width))
        self.heads = nn.ModuleList(_normed(nn.Linear(width, width), every) for _ in ATTRIBUTE_WIDTHS)
        self.outputs = nn.ModuleList(_normed(nn.Linear(width, size), every) for size in ATTRIBUTE_WIDTHS)

    def forward(self, displacement: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 11"]:
        """Columns as in `ATTRIBUTES`."""
        points = displacement.flatten(0, -2)
        outputs = _on_gpu(points, self.plan()) if on_gpu(points) else point_network(points, self.layers())
        return outputs.unflatten(0, displacement.shape[:-1])

    def plan(self) -> list[PlannedLayer]:
        """The same layers for a GPU, which multiplies none."""
        activations: list[Activation] = ["relu", "relu", "relu" if self.every else "none"]
        plan = [
            PlannedLayer([Rows(_as_linear(layer))], own) for layer, own in zip(self.trunk, activations, strict=True)
        ]
        width = _as_linear(self.heads[0]).out_features
        last = [Rows(_as_linear(output), index * width) for index, output in enumerate(self.outputs)]
        return [*plan, PlannedLayer([Rows(_as_linear(head)) for head in self.heads], "relu"), PlannedLayer(last)]

    def layers(self) -> list[Layer]:
        """An equivalent plain network with ReLU between all of its layers."""
        *trunk, third = (Layer(_as_linear(layer).weight, _as_linear(layer).bias, "relu") for layer in self.trunk)
        fan_out = _beside([_as_linear(head) for head in self.heads], "relu")
        last = _block_diagonal([(_as_linear(output).weight, _as_linear(output).bias) for output in self.outputs])
        if self.every:
            return [*trunk, third, fan_out, last]
        # There is no activation after the third layer, as in the published code: it and the next are one linear map.
        joined = Layer(fan_out.weight @ third.weight, fan_out.weight @ third.bias + fan_out.bias, "relu")
        return [*trunk, joined, last]


def _on_gpu(inputs: Float[Tensor, "n i"], plan: Sequence[PlannedLayer]) -> Float[Tensor, "n o"]:
    from mien.avatar.ops.point_network_gpu import packed, packed_network, structure_of

    structure = structure_of(inputs.shape[1], plan)
    return packed_network(inputs, packed(plan, structure), structure)


def _beside(layers: list[nn.Linear], activation: Activation) -> Layer:
    return Layer(torch.cat([layer.weight for layer in layers]), torch.cat([layer.bias for layer in layers]), activation)


def _block_diagonal(layers: Sequence[tuple[Tensor, Tensor]]) -> Layer:
    """Layers, each of which reads its own columns, as one."""
    return Layer(torch.block_diag(*(weight for weight, _ in layers)), torch.cat([bias for _, bias in layers]))


def _normed(layer: nn.Linear, wanted: bool) -> nn.Linear:
    """The layer, with weight normalisation if it is wanted. Its weights stay the same."""
    return _as_linear(weight_norm(layer)) if wanted else layer


def _as_linear(layer: nn.Module) -> nn.Linear:
    assert isinstance(layer, nn.Linear)
    return layer


def _linear(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, std=math.sqrt(2 / outputs))
    nn.init.zeros_(layer.bias)
    return layer
