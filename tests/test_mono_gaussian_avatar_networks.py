"""MonoGaussianAvatar's networks have the published layers and first weights."""

import pytest
import torch
from torch import Tensor

from mien.avatar.encoding import positional_encoding
from mien.avatar.mono_gaussian_avatar.networks import AttributeChangeNet, AttributeNet, DeformationNet


def linear(layer: torch.nn.Module) -> torch.nn.Linear:
    assert isinstance(layer, torch.nn.Linear)
    return layer


def softplus(values: Tensor) -> Tensor:
    return torch.nn.functional.softplus(values, beta=100)


def test_change_network_has_the_published_layers() -> None:
    torch.manual_seed(0)
    network, values = AttributeChangeNet(16), torch.randn(9, 3)
    first, second, third = network.trunk
    trunk = third(second(first(values).relu()).relu())  # no activation after the third
    heads = zip(network.heads, network.outputs, strict=True)
    expected = torch.cat([output(head(trunk).relu()) for head, output in heads], dim=-1)
    torch.testing.assert_close(network(values), expected)


def test_attribute_network_has_the_published_layers() -> None:
    torch.manual_seed(0)
    network, points = AttributeNet(48, 7, 6), torch.randn(9, 3)
    encoding = values = positional_encoding(points, 6)
    for index, layer in enumerate(network.trunk):
        if index == 3:
            assert values.shape[1] == 48 - 39
            values = torch.cat([values, encoding], dim=-1) / 2**0.5
        values = softplus(layer(values))
    hidden = [softplus(head(values)) for head in network.heads]
    hidden[3] = network.color(hidden[3])
    expected = torch.cat([output(one) for output, one in zip(network.outputs, hidden, strict=True)], dim=-1)
    torch.testing.assert_close(network(points), expected)


@torch.no_grad()
def test_attribute_network_starts_with_the_published_weights() -> None:
    torch.manual_seed(0)
    network = AttributeNet(256, 7, 6)
    first, last, skip = (linear(network.trunk[index]) for index in (0, -1, 3))
    # The waves have no effect at first, and the positions have no more than theirs.
    assert first.weight[:, 3:].abs().max() == skip.weight[:, -36:].abs().max() == 0
    assert float(first.weight[:, :3].std()) == pytest.approx((2 / 256) ** 0.5, rel=0.1)
    assert float(last.weight.mean()) == pytest.approx((torch.pi / 256) ** 0.5, rel=1e-3)
    assert float(last.weight.std()) == pytest.approx(1e-4, rel=0.1)
    assert last.bias.unique().tolist() == pytest.approx([-0.6])
    # About the distance to a sphere.
    points = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    distances = []
    for radius in (0.7, 1.4):
        values = encoding = positional_encoding(radius * points, 6)
        for index, layer in enumerate(network.trunk):
            values = softplus(layer(torch.cat([values, encoding], -1) / 2**0.5 if index == 3 else values))
        distances.append(float(values.mean()))
    assert distances[1] > distances[0] + 0.2


def test_summed_directions_are_exactly_the_sums_of_directions() -> None:
    torch.manual_seed(0)
    network = DeformationNet(16, 4, 9, 5).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    points, coefficients = torch.randn(7, 3).double(), torch.randn(2, 13).double()
    offset, moved, weights = network(points, coefficients)
    found = network.whole(points)
    directions = torch.cat([found.expression, found.pose], dim=-1)
    torch.testing.assert_close(moved, torch.einsum("nxc,bc->bnx", directions, coefficients))
    torch.testing.assert_close(offset, found.offset)
    torch.testing.assert_close(weights, found.weights)
    values = points
    for layer in network.trunk:
        values = softplus(layer(values))
    expected = network.directions(values).unflatten(-1, (3, 14))
    torch.testing.assert_close(torch.cat([found.offset[..., None], directions], dim=-1), expected)
    torch.testing.assert_close(weights, (20 * network.skinning(softplus(network.hidden(values)))).softmax(-1))


def test_the_published_skinning_branch_has_weight_norm_and_the_start_of_the_trunk() -> None:
    torch.manual_seed(0)
    plain, published = DeformationNet(400, 4, 9, 5), DeformationNet(400, 4, 9, 5, skinning_norm=True)
    assert isinstance(published.hidden, torch.nn.Linear)
    assert float(published.hidden.weight.detach().std()) == pytest.approx((2 / 400) ** 0.5, rel=0.02)
    assert published.hidden.bias.abs().max() == 0
    assert {name for name, _ in published.named_parameters() if name.startswith("hidden.")} == {
        "hidden.bias",
        "hidden.parametrizations.weight.original0",
        "hidden.parametrizations.weight.original1",
    }
    assert {name for name, _ in plain.named_parameters() if name.startswith("hidden.")} == {
        "hidden.weight",
        "hidden.bias",
    }
    torch.testing.assert_close(published.whole(torch.randn(7, 3)).weights, torch.full((7, 5), 0.2))


def test_deformation_starts_as_nothing_with_even_weights() -> None:
    found = DeformationNet(16, 4, 9, 5).whole(torch.randn(7, 3))
    assert found.offset.abs().max() == found.expression.abs().max() == found.pose.abs().max() == 0
    torch.testing.assert_close(found.weights, torch.full((7, 5), 0.2))


@pytest.mark.parametrize("layers", [2, 3, 4, 7])
def test_attribute_network_of_any_depth(layers: int) -> None:
    """The attribute network can have any depth."""
    assert AttributeNet(48, layers, 6)(torch.randn(5, 3)).shape == (5, 11)
