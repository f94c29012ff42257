"""The network of points has the right softplus everywhere, and avatars with networks pose their baked form as numpy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from known import known
from mien import runtime
from mien.avatar import Avatar, load_avatar
from mien.avatar.files import write_avatar
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.ops.point_network import Activation, Layer, point_network, point_network_reference
from mien.avatar.settings import Progress
from mien.face import FaceParams
from mien.runtime import posing
from mien.runtime.baked import BlendSkinned
from mono_avatars import new_avatar
from plain_settings import plain_mono_gaussian_avatar
from toy_scene import random, runtime_face, toy_face, toy_face_model

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


PARTS = ("means", "quats", "scales", "opacities", "sh", "T_world_local")
with_networks = pytest.mark.parametrize("method", ["headgas", "mono_gaussian_avatar"])


def moved_avatar(method: str) -> Avatar:
    """An avatar whose networks all do something, and which is not in training mode."""
    if method == "headgas":
        torch.manual_seed(0)
        avatar: Avatar = HeadGas(HeadGasConfig(points=50, directions=3), toy_face_model(), toy_face(5))
        avatar.store.assign("bases", torch.randn(avatar.store["bases"].shape))
    else:
        avatar = new_avatar()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    avatar.eval()
    return avatar


def difference(avatar: Avatar, face: FaceParams) -> float:
    """The largest difference of any property between the baked form and the networks."""
    baked = avatar.pose(face).gaussians
    avatar.train()
    own = avatar.pose(face).gaussians
    avatar.eval()
    own = replace(own, quats=torch.nn.functional.normalize(own.quats, dim=-1).expand_as(baked.quats))
    own = replace(own, means=own.means.expand_as(baked.means), scales=own.scales.expand_as(baked.scales))
    pairs = [(getattr(baked, name), getattr(own, name)) for name in PARTS]
    assert all(a.shape == b.shape for a, b in pairs)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


@with_networks
def test_the_baked_form_is_what_the_networks_give(method: str, tmp_path: Path) -> None:
    avatar, face = moved_avatar(method), toy_face(5)
    assert difference(avatar, face) < 1e-5
    assert not avatar.pose(face).gaussians.means.requires_grad
    write_avatar(tmp_path, avatar)
    loaded = load_avatar(tmp_path)
    assert not loaded.training
    assert torch.equal(loaded.pose(face).gaussians.sh, avatar.pose(face).gaussians.sh)
    assert difference(loaded, face) < 1e-5
    with torch.no_grad():
        avatar.store["means"].mul_(0.9)
    assert difference(avatar, face) < 1e-5
    avatar.store.select(torch.arange(3))
    assert avatar.pose(face).gaussians.means.shape == (5, 3, 3)


@with_networks
def test_it_is_baked_once_and_not_for_gradients_or_a_step(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, face = moved_avatar(method), toy_face(5)[0]
    bake, calls = avatar.bake, []
    monkeypatch.setattr(avatar, "bake", lambda: (calls.append(0), bake())[1])
    wanted = replace(face, expression=face.expression.clone().requires_grad_())
    posed = avatar.pose(wanted).gaussians
    (posed.means.sum() + posed.sh.square().sum()).backward()
    assert known(wanted.expression.grad).any()
    assert avatar.pose(face, Progress(0, 10, 0, 1.0)).gaussians.sh.requires_grad
    assert not calls
    avatar.pose(face)
    avatar.pose(toy_face(5)[1])
    assert len(calls) == 1


@pytest.mark.parametrize("sizes", NETWORKS, ids=lambda sizes: f"{sizes[0]} points")
def test_outputs_alone_have_the_bits_of_those_with_gradients(isa: str, sizes: Sizes) -> None:
    inputs, *parameters = arguments(sizes)
    alone = point_network(inputs, layers_of(sizes, parameters))
    assert torch.equal(alone, point_network(inputs.requires_grad_(), layers_of(sizes, parameters)).detach())


def baked_avatar(points: int) -> BlendSkinned:
    return new_avatar(plain_mono_gaussian_avatar(points=points)).bake()


def test_activations_have_the_bits_of_numpy(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    baked, face = baked_avatar(3000), runtime_face(toy_face(5)[3])
    found = runtime.pose(baked, face)
    monkeypatch.setattr(posing, "has_native_activations", lambda baked: False)
    expected = runtime.pose(baked, face)
    for name in PARTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), strict=True, err_msg=name)


def test_other_avatars_keep_the_path_of_numpy() -> None:
    baked = baked_avatar(20)
    assert posing.has_native_activations(baked)
    network = known(baked.network)
    for change in (
        {"network": None}, {"network": replace(network, activation="softplus")},
        {"network": replace(network, outputs=("sh",))}, {"scale_activation": "exp"}, {"color_activation": "sh"},
        {"attributes": replace(baked.attributes, sh=np.zeros((20, 4, 3), np.float32))},
    ):  # fmt: skip
        assert not posing.has_native_activations(replace(baked, **change)), change
