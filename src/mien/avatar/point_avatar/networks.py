"""The two networks of PointAvatar that its successor does not have: surface with albedo, and light by normals.

Lengths are in units of `LENGTH_UNIT`.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from mien.avatar.ops.points import positional_encoding

_SHARPNESS = 100.0
_SPHERE = 0.5


class Surface(NamedTuple):
    """Outputs of the surface network for n points."""

    distance: Float[Tensor, " n"]
    """Signed distance to the surface, positive outside."""
    slope: Float[Tensor, "n 3"]
    """Gradient of the distance by the position. Its direction is the normal."""
    albedo: Float[Tensor, "n 3"]
    """Logits of the colour without light."""


class SurfaceNet(nn.Module):
    """Signed distance, its slope, and albedo, given positions. At first about the distance to a sphere.

    The slope is computed along with the distance by the chain rule, layer by layer. One backward pass then goes through
    both, which automatic differentiation of a derivative would need two for.
    """

    def __init__(self, width: int, layers: int, bands: int):
        super().__init__()
        self.bands = bands
        sizes = [3 + 6 * bands, *[width] * layers]
        plain = [nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:], strict=True)]
        self.distance, self.albedo = nn.Linear(width, 1), nn.Linear(width, 3)
        with torch.no_grad():
            for layer in plain:
                layer.weight.normal_(std=math.sqrt(2 / layer.out_features))
                layer.bias.zero_()
            # Start with smooth functions of the position, as a sphere is.
            plain[0].weight[:, 3:] = 0
            self.distance.weight.normal_(math.sqrt(math.pi / width), 1e-4)
            self.distance.bias.fill_(-_SPHERE)
        # Last, so that the norms are those of the weights above.
        self.trunk = nn.ModuleList(weight_norm(layer) for layer in plain)

    def forward(self, points: Float[Tensor, "n 3"]) -> Surface:
        """Everything about some points."""
        values, slopes = positional_encoding(points, self.bands), slopes_of_encoding(points, self.bands)
        for layer in self.trunk:
            weight, bias = _parts(layer)
            raw = torch.addmm(bias, values, weight.T)
            values = nn.functional.softplus(raw, beta=_SHARPNESS)
            slopes = torch.sigmoid(_SHARPNESS * raw)[..., None] * (weight @ slopes)
        return Surface(self.distance(values)[:, 0], (self.distance.weight @ slopes)[:, 0], self.albedo(values))


class ShadingNet(nn.Module):
    """The light on a surface, given its normal, as a factor of 0 to 2 on each colour. At first 1."""

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.light = nn.Linear(width, 3)
        nn.init.zeros_(self.light.weight)
        nn.init.zeros_(self.light.bias)

    def forward(self, normals: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Factors on the colours."""
        return 2 * torch.sigmoid(self.light(self.layers(normals)))


def slopes_of_encoding(points: Float[Tensor, "n 3"], bands: int) -> Float[Tensor, "n c 3"]:
    """Gradients of the encoding by the position."""
    scales = 2.0 ** torch.arange(bands, dtype=points.dtype, device=points.device)[:, None]
    angles = points[..., None, :] * scales
    waves = torch.stack([angles.cos() * scales, -angles.sin() * scales], dim=-2).flatten(-3)
    each = torch.eye(3, dtype=points.dtype, device=points.device).repeat(2 * bands, 1)
    own = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
    return torch.cat([own, waves[..., None] * each], dim=1)


def _parts(layer: nn.Module) -> tuple[Tensor, Tensor]:
    assert isinstance(layer, nn.Linear)
    return layer.weight, layer.bias
