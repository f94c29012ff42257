"""MonoGaussianAvatar's networks have the published layers and first weights, and near vertices take little memory."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mien.avatar import Progress
from mien.avatar.encoding import positional_encoding
from mien.avatar.mono_gaussian_avatar import motion
from mien.avatar.mono_gaussian_avatar.motion import nearest_vertices
from mien.avatar.mono_gaussian_avatar.networks import AttributeChangeNet, AttributeNet, DeformationNet
from mono_avatars import new_avatar, pictured
from plain_settings import plain_mono_gaussian_avatar
from toy_scene import toy_face, toy_face_model


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
    assert [AttributeNet(48, layers, 6)(points).shape for layers in (2, 3, 4, 7)] == [(9, 11)] * 4


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


def test_nearest_vertices_on_a_cpu_take_no_distances_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = torch.tensor([[0.6, 0.1, 0], [0.1, 0.1, 5], [0.4, 0.55, 0]])
    assert nearest_vertices(points.double(), vertices.double()).tolist() == [1, 0, 2]
    monkeypatch.delattr(torch, "addmm")
    assert nearest_vertices(points, vertices).tolist() == [1, 0, 2]
    points[0, 0] = float("nan")
    assert nearest_vertices(points, vertices)[1:].tolist() == [0, 2]


def test_nearest_vertices_of_many_points_take_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points are looked at in parts where there is no tree, as on a GPU."""
    random = torch.Generator().manual_seed(0)
    points, vertices = (torch.randn(n, 3, generator=random, dtype=torch.float64) for n in (1000, 50))
    monkeypatch.setattr(motion, "POINTS_AT_ONCE", 64)
    sizes: list[int] = []
    addmm = torch.addmm
    monkeypatch.setattr(torch, "addmm", lambda *args, **more: sizes.append(len(args[1])) or addmm(*args, **more))
    found = nearest_vertices(points, vertices)
    assert torch.equal(found, (points[:, None] - vertices).norm(dim=-1).argmin(1))
    assert max(sizes) == 64


def test_losses_near_the_face_model_hold_no_distances_of_all_pairs() -> None:
    """Their largest array is some numbers for each point, with any number of vertices."""
    model = toy_face_model(rings=40, around=40)
    points, vertices = 20_000, len(model.template)
    outputs = 3 * (1 + model.expression_basis.shape[0] + 9 * len(model.free_joint_names)) + len(model.joint_names) + 1
    avatar = new_avatar(plain_mono_gaussian_avatar(points=points, max_points=points, face_points=points), model)
    with LargestArray() as arrays:
        losses = avatar.regularizers(avatar.pose(toy_face(5)[0]), pictured(points), Progress(0, 100))
        torch.stack(list(losses.values())).sum().backward()
    widest = 2 * max(outputs, 2 * avatar.config.deformation_width)
    assert widest < vertices / 3, "the bound would not see them"
    assert points <= arrays.numbers <= points * widest


class LargestArray(TorchDispatchMode):
    """Notes how many numbers the largest array has that PyTorch makes."""

    numbers = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        tensors = made if isinstance(made, tuple | list) else (made,)
        self.numbers = max([self.numbers, *(one.numel() for one in tensors if isinstance(one, Tensor))])
        return made


def test_neighbors_are_found_where_points_are_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """A point that moves to another vertex within a round is compared with that one."""
    avatar, asked = new_avatar(), []
    monkeypatch.setattr(motion, "nearest_vertices", lambda *them: asked.append(nearest_vertices(*them)) or asked[-1])
    for _ in range(2):
        avatar.regularizers(avatar.pose(toy_face(5)[0]), pictured(30), Progress(0, 100))
        with torch.no_grad():
            avatar.store["means"].neg_()
    assert (asked[0] != asked[1]).float().mean() > 0.9
