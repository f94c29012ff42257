"""The three networks of MonoGaussianAvatar: attributes at rest, deformation of points, change of attributes.

Their inputs and outputs that are lengths are in units of `LENGTH_UNIT`.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from mien.avatar.encoding import positional_encoding

LENGTH_UNIT = 0.25
"""Unit of length, in metres. The paper's head model is four times life size, and its radii and weights fit that."""
SKINNING_SHARPNESS = 20.0
"""Factor on the logits of the skinning weights: their softmax has a temperature of 1/20."""
_ENCODING_BANDS = 6
_SOFTPLUS_SHARPNESS = 100.0

ATTRIBUTES = ("log_scales", "quats", "opacity_logits", "sh")
"""Outputs of the attribute networks, in the order of their columns."""
ATTRIBUTE_WIDTHS = (3, 4, 1, 3)
"""Number of columns of each output. Colours and scales go through a sigmoid: `log_scales` and `sh` are logits."""


class AttributeNet(nn.Module):
    """Raw attributes of a point at rest, given its position.

    Unlike in the published code, the trunk is initialised as a plain network, not as a signed distance to a sphere.
    """

    def __init__(self, width: int, layers: int):
        super().__init__()
        inputs = 3 + 6 * _ENCODING_BANDS
        # The encoding enters a second time after the third layer, which has fewer outputs to make room for it.
        self.skip = 3 if layers > 3 else None
        sizes = [inputs, *[width] * layers]
        outputs = [size - inputs if index + 1 == self.skip else size for index, size in enumerate(sizes[1:])]
        assert min(outputs) > 0, f"attribute width {width} leaves no room for {inputs} columns of encoding"
        self.trunk = nn.ModuleList(_normed(i, o) for i, o in zip(sizes[:-1], outputs, strict=True))
        with torch.no_grad():
            # Start with smooth functions of the position. The waves of the encoding come in as training needs them.
            self.trunk[0].parametrizations.weight.original1[:, 3:] = 0  # type: ignore[union-attr, index]
        self.colour = nn.Sequential(nn.Linear(width, width), _softplus(), nn.Linear(width, 3))
        self.scale = nn.Sequential(nn.Linear(width, width), _softplus(), nn.Linear(width, 3))
        self.rotation = nn.Linear(width, 4)
        self.opacity = nn.Linear(width, 1)
        with torch.no_grad():
            self.rotation.bias.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 11"]:
        """Columns as in `ATTRIBUTES`."""
        encoding = positional_encoding(points, _ENCODING_BANDS)
        values = encoding
        for index, layer in enumerate(self.trunk):
            if index == self.skip:
                values = torch.cat([values, encoding], dim=-1) / math.sqrt(2)
            values = nn.functional.softplus(layer(values), beta=_SOFTPLUS_SHARPNESS)
        heads = (self.scale, self.rotation, self.opacity, self.colour)
        return torch.cat([head(values) for head in heads], dim=-1)


class DeformationNet(nn.Module):
    """Offset, blend directions and skinning weights of a point, given its position. At first zero, zero, equal."""

    def __init__(self, width: int, expressions: int, pose_features: int, joints: int):
        super().__init__()
        self.expressions, self.pose_features = expressions, pose_features
        layers = [layer for size in (3, width, width, width) for layer in (_normed(size, width), _softplus())]
        self.trunk = nn.Sequential(*layers)
        self.directions = nn.Linear(width, 3 * (1 + expressions + pose_features))
        self.skinning = nn.Sequential(nn.Linear(width, width), _softplus(), nn.Linear(width, joints))
        for last in (self.directions, self.skinning[-1]):
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(
        self, points: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 e"], Float[Tensor, "n 3 p"], Float[Tensor, "n k"]]:
        """Offset O, expression directions E, pose correctives P, and skinning weights W that sum to 1."""
        values = self.trunk(points)
        widths = [1, self.expressions, self.pose_features]
        offset, expression, pose = self.directions(values).unflatten(-1, (3, sum(widths))).split(widths, dim=-1)
        weights = (SKINNING_SHARPNESS * self.skinning(values)).softmax(-1)
        return offset[..., 0], expression, pose, weights


class AttributeChangeNet(nn.Module):
    """Changes of a point's raw attributes, given its motion from the canonical position."""

    def __init__(self, width: int):
        super().__init__()
        # There is no activation after the third layer, as in the published code: this layer and the next form one
        # linear map.
        first, second, third = (weight_norm(nn.Linear(size, width)) for size in (3, width, width))
        self.trunk = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), third)
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size)) for size in ATTRIBUTE_WIDTHS
        )

    def forward(self, displacement: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 11"]:
        """Columns as in `ATTRIBUTES`."""
        values = self.trunk(displacement)
        return torch.cat([head(values) for head in self.heads], dim=-1)

    def flattened(self) -> tuple[list[Tensor], list[Tensor]]:
        """Weights and biases of an equivalent plain network with ReLU between all of its four layers."""
        before = [_weight_and_bias(self.trunk[index]) for index in (0, 2)]
        (third, third_bias), hidden = _weight_and_bias(self.trunk[4]), self._layers(0)
        fan_out, fan_out_bias = (torch.cat(parts) for parts in zip(*hidden, strict=True))
        last = self._layers(2)
        layers = [
            *before,
            (fan_out @ third, fan_out @ third_bias + fan_out_bias),
            (torch.block_diag(*(weight for weight, _ in last)), torch.cat([bias for _, bias in last])),
        ]
        return [weight for weight, _ in layers], [bias for _, bias in layers]

    def _layers(self, index: int) -> list[tuple[Tensor, Tensor]]:
        return [_weight_and_bias(head.get_submodule(str(index))) for head in self.heads]


def _weight_and_bias(layer: nn.Module) -> tuple[Tensor, Tensor]:
    assert isinstance(layer, nn.Linear)
    return layer.weight.detach(), layer.bias.detach()


def _normed(inputs: int, outputs: int) -> nn.Module:
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, std=math.sqrt(2 / outputs))
    nn.init.zeros_(layer.bias)
    return weight_norm(layer)


def _softplus() -> nn.Softplus:
    return nn.Softplus(beta=_SOFTPLUS_SHARPNESS)
