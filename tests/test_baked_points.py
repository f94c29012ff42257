"""What the runtime does natively with points of mono_gaussian_avatar gives the bits of numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mien import _native, runtime
from mien.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.networks import AttributeChangeNet, AttributeNet, DeformationNet
from mien.runtime import posing
from mien.runtime.baked import BlendSkinned
from plain_settings import plain_mono_gaussian_avatar
from test_point_network import NETWORKS, Sizes, arguments, layers_of, point_network
from toy_scene import runtime_face, toy_face, toy_face_model


@pytest.mark.parametrize("sizes", NETWORKS, ids=lambda sizes: f"{sizes[0]} points")
def test_outputs_alone_have_the_bits_of_those_with_gradients(isa: str, sizes: Sizes) -> None:
    inputs, *parameters = arguments(sizes)
    alone = point_network(inputs, layers_of(sizes, parameters))
    assert torch.equal(alone, point_network(inputs.requires_grad_(), layers_of(sizes, parameters)).detach())


def test_zeros_of_joined_layers_cost_no_bit(isa: str) -> None:
    """The networks' last layers have blocks of zeros, which the outputs alone leave out."""
    torch.manual_seed(0)
    points = torch.randn(500, 3)
    deformation = DeformationNet(32, 5, 9, 4)
    for last in (deformation.directions, deformation.skinning):
        torch.nn.init.normal_(last.weight)
    for network in (AttributeNet(64, 4, 3), AttributeChangeNet(32), lambda given: deformation.whole(given).expression):
        with torch.no_grad():
            alone = network(points)
        assert alone.abs().max() > 0
        assert torch.equal(alone, network(points).detach())


def baked_avatar(points: int = 3000) -> BlendSkinned:
    torch.manual_seed(0)
    avatar = MonoGaussianAvatar(plain_mono_gaussian_avatar(points=points), toy_face_model(), toy_face(5))
    with torch.no_grad():
        for network in (avatar.attributes, avatar.deformation, avatar.change):
            for parameter in network.parameters():
                parameter.add_(0.05 * torch.randn(parameter.shape))
    return avatar.bake()


def test_activations_have_the_bits_of_numpy(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    baked, face = baked_avatar(), runtime_face(toy_face(5)[3])
    found = runtime.pose(baked, face)
    monkeypatch.setattr(posing, "_has_native_activations", lambda baked: False)
    expected = runtime.pose(baked, face)
    for name in ("means", "quats", "scales", "opacities", "sh", "T_world_local"):
        assert getattr(found, name).shape == getattr(expected, name).shape
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def test_other_avatars_keep_the_path_of_numpy() -> None:
    baked = baked_avatar(20)
    assert baked.network is not None
    assert posing._has_native_activations(baked)
    softplus, no_scales = replace(baked.network, activation="softplus"), replace(baked.network, outputs=("sh",))
    for other in (
        replace(baked, network=None),
        replace(baked, network=softplus),
        replace(baked, network=no_scales),
        replace(baked, scale_activation="exp"),
        replace(baked, color_activation="sh"),
        replace(baked, attributes=replace(baked.attributes, sh=np.zeros((20, 4, 3), np.float32))),
    ):
        assert not posing._has_native_activations(other)


def test_a_bone_that_is_no_joint_adds_its_share() -> None:
    random = np.random.default_rng(0)
    shaped, weights, transform, posed = (
        random.normal(size=size).astype(np.float32) for size in ((2500, 3), (2500,), (3, 4), (2500, 3))
    )
    expected = posed + weights[:, None] * (shaped.astype(np.float64) @ transform[:, :3].T + transform[:, 3])
    before, found = _native.thread_count(), []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        found.append(posed.copy())
        _native.add_bone(shaped, weights, transform, found[-1])
    _native.set_thread_count(before)
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
    np.testing.assert_array_equal(*found)
