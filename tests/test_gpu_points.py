"""Kernels for a GPU move points and run their networks as plain PyTorch does, forward and backward, in Triton's
interpreter without a GPU. `test_gpu_kernels` says how exact they are."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mien.avatar.avatar import move_avatar
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar, split_attributes
from mien.avatar.mono_gaussian_avatar.networks import AttributeChangeNet, AttributeNet
from mien.avatar.ops.point_network import point_network_reference
from mien.gaussians import sh_from_rgb
from mono_avatars import SMALL, new_avatar
from test_gpu_kernels import assert_close, dtypes, jointed, numbers, same, weighted
from toy_scene import toy_face, toy_face_model

pytest.importorskip("triton", reason="kernels for a GPU are written in Triton")
pytestmark = pytest.mark.unchecked


def same_by_parameters(reference: Callable, kernel: Callable, networks: list[nn.Module], inputs: list[Tensor]) -> None:
    """Check results, and gradients by parameters and inputs."""
    both = []
    for function in (reference, kernel):
        for network in networks:
            network.zero_grad()
        own = [one.detach().clone().requires_grad_() for one in inputs]
        results = function(*own)
        weighted(results).backward()
        known = {name: one.grad for network in networks for name, one in network.named_parameters()}
        both.append((results, [one.grad for one in own], known))
    (expected, of_inputs, of_parameters), (found, *others) = both
    for index, (one, other) in enumerate(zip(expected, found, strict=True)):
        assert_close(one, other, f"result {index}")
    for index, (one, other) in enumerate(zip(of_inputs, others[0], strict=True)):
        assert_close(one, other, f"gradient by input {index}")
    for name, one in of_parameters.items():
        # A derivative by the length of a row is a sum whose terms may cancel.
        assert_close(one, others[1][name], f"gradient by {name}")


def disturbed(network: nn.Module, like: Tensor) -> nn.Module:
    with torch.no_grad():
        for index, parameter in enumerate(network.to(like).parameters()):
            parameter.add_(0.05 * numbers(parameter, *parameter.shape, seed=index))
    return network


@dtypes
@pytest.mark.parametrize("n", [0, 70])
@pytest.mark.parametrize("every", [False, True])
def test_networks_of_points(like: Tensor, n: int, every: bool) -> None:
    """Layers read the inputs again, are linear, and lie side by side. 70 points are more than one program's."""
    from mien.avatar.ops.point_network_gpu import packed, packed_network, structure_of

    torch.manual_seed(0)
    for network, width in ((AttributeNet(12, 5, 1, False, every), 9), (AttributeChangeNet(7, every), 3)):
        known: Any = disturbed(network, like)
        structure = structure_of(width, known.plan())
        same_by_parameters(
            lambda own, known=known: [point_network_reference(own, known.layers())],
            lambda own, known=known, sizes=structure: [packed_network(own, packed(known.plan(), sizes), sizes)],
            [known], [numbers(like, n, width)],
        )  # fmt: skip


def test_a_point_that_is_not_finite_stays_alone() -> None:
    from mien.avatar.ops.point_network_gpu import packed, packed_network, structure_of

    network, points = AttributeChangeNet(7), numbers(torch.zeros(()), 5, 3)
    points[2, 1] = math.nan
    structure = structure_of(3, network.plan())
    found = packed_network(points, packed(network.plan(), structure), structure)
    assert_close(point_network_reference(points, network.layers()), found)
    assert found.isnan().any(1).tolist() == [False, False, True, False, False]


def avatar_of(like: Tensor, points: int, model: Any, **changes: Any) -> MonoGaussianAvatar:
    avatar = new_avatar(replace(SMALL, points=max(points, 1), deformation_width=6, **changes), model)
    move_avatar(avatar, like)
    return avatar


@dtypes
@pytest.mark.parametrize(("n", "timesteps"), [(0, 1), (1, 2), (140, 1)])
def test_moved_points(like: Tensor, n: int, timesteps: int) -> None:
    """The joint `jaw` moves with the neck, and one joint moves no skin."""
    model = jointed(torch.zeros(()))
    weights = model.skinning_weights.clone()
    weights[:, 0], weights[:, 1] = weights[:, 0] + weights[:, 1], 0
    avatar = avatar_of(like, n, replace(model, skinning_weights=weights), weight_norm="paper")
    faces = toy_face(5)[1 : 1 + timesteps].to(like)
    names = ("expression", "joints", "head_rotation", "head_translation")

    def moved(function: Callable) -> Callable:
        return lambda means, *own: function(means, replace(faces, **dict(zip(names, own, strict=True))))

    inputs = [avatar.store["means"][:n], *(getattr(faces, name) for name in names)]
    same_by_parameters(moved(avatar.deformed), moved(avatar._moved_by_kernels), [avatar.deformation], inputs)


@dtypes
@pytest.mark.parametrize(("n", "units", "model"), [(19, "each", jointed), (1, "own", jointed), (19, "mean", None)])
def test_losses_near_the_face_model(like: Tensor, n: int, units: Any, model: Any) -> None:
    """The second model has no pose features of its own."""
    known = toy_face_model() if model is None else model(torch.zeros(()))
    avatar = avatar_of(like, n, known, face_expression_units=units, face_skinning_weight=2.0)
    means = numbers(like, n, 3)
    same_by_parameters(
        lambda: [*avatar.face_losses(means, 0.5).values()],
        lambda: [*avatar._face_losses_by_kernels(means, 0.5).values()],
        [avatar.deformation], [],
    )  # fmt: skip
    if n > 1:
        means[3, 1] = math.nan
        assert all(bool(one.isnan()) for one in avatar._face_losses_by_kernels(means, 1.0).values())


@dtypes
@pytest.mark.parametrize("n", [0, 1, 137])
@pytest.mark.parametrize("own", [False, True])
def test_activated_attributes(like: Tensor, n: int, own: bool) -> None:
    from mien.avatar.mono_gaussian_avatar.motion_gpu import activated

    def reference(given: dict[str, Tensor]) -> list[Tensor]:
        raw = split_attributes(given["rest"] + given["change"] + given.get("own", 0))
        quats = torch.nn.functional.normalize(raw["quats"], dim=-1)
        colors = sh_from_rgb(raw["sh"].sigmoid())[..., None, :]
        return [0.3 * raw["log_scales"].sigmoid() + 0.1, quats, raw["opacity_logits"][..., 0].sigmoid(), colors]

    tensors = {"rest": numbers(like, n, 11), "change": numbers(like, 2, n, 11, seed=1)}
    if own:
        tensors["own"] = numbers(like, n, 11, seed=2)
    same(reference, lambda given: [*activated(given["rest"], given.get("own"), given["change"], 0.3, 0.1)], tensors)
