"""Loaded avatars of methods with networks pose their baked form, which is their networks' result."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mien.avatar import Avatar, HeadGas, load_avatar
from mien.avatar.files import write_avatar
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.schedules import Progress
from mien.face import FaceParams
from mono_avatars import new_avatar
from toy_scene import toy_face, toy_face_model

method = pytest.mark.parametrize("method", ["headgas", "mono_gaussian_avatar"])


def moved_avatar(method: str) -> Avatar:
    """An avatar whose networks all do something, and which is not in training mode."""
    if method == "headgas":
        torch.manual_seed(0)
        avatar: Avatar = HeadGas(HeadGasConfig(points=50, directions=3), toy_face_model(), toy_face(5))
        avatar.gaussian_store().assign("bases", torch.randn(avatar.gaussian_store()["bases"].shape))
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
    names = ("means", "quats", "scales", "opacities", "sh", "T_world_local")
    own = replace(own, quats=torch.nn.functional.normalize(own.quats, dim=-1).expand_as(baked.quats))
    own = replace(own, means=own.means.expand_as(baked.means), scales=own.scales.expand_as(baked.scales))
    pairs = [(getattr(baked, name), getattr(own, name)) for name in names]
    assert all(a.shape == b.shape for a, b in pairs)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


@method
def test_the_baked_form_is_what_the_networks_give(method: str) -> None:
    avatar, face = moved_avatar(method), toy_face(5)
    assert difference(avatar, face) < 1e-5
    assert not avatar.pose(face).gaussians.means.requires_grad
    with torch.no_grad():
        avatar.gaussian_store()["means"].mul_(0.9)
    assert difference(avatar, face) < 1e-5
    avatar.gaussian_store().select(torch.arange(3))
    assert avatar.pose(face).gaussians.means.shape == (5, 3, 3)


@method
def test_it_is_baked_once(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, face = moved_avatar(method), toy_face(5)
    bake, calls = avatar.bake, []
    monkeypatch.setattr(avatar, "bake", lambda: (calls.append(0), bake())[1])
    avatar.pose(face[0])
    avatar.pose(face[1])
    assert len(calls) == 1


@method
def test_networks_run_where_gradients_or_a_step_are_asked_for(method: str) -> None:
    avatar, face = moved_avatar(method), toy_face(5)[0]
    wanted = replace(face, expression=face.expression.clone().requires_grad_())
    posed = avatar.pose(wanted).gaussians
    (posed.means.sum() + posed.sh.square().sum()).backward()
    assert wanted.expression.grad is not None
    assert bool(wanted.expression.grad.any())
    assert avatar.pose(face, Progress(0, 10, 0, 1.0)).gaussians.sh.requires_grad


@method
def test_a_loaded_avatar_poses_its_baked_form(method: str, tmp_path: Path) -> None:
    avatar, face = moved_avatar(method), toy_face(5)[2]
    write_avatar(tmp_path / "avatar", avatar)
    loaded = load_avatar(tmp_path / "avatar")
    assert not loaded.training
    assert torch.equal(loaded.pose(face).gaussians.sh, avatar.pose(face).gaussians.sh)
    assert difference(loaded, face) < 1e-5
