"""A loaded avatar of mono_gaussian_avatar poses its baked form, which is its networks' result."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mien.avatar import MonoGaussianAvatar, load_avatar
from mien.avatar.files import write_avatar
from mien.avatar.schedules import Progress
from mien.face import FaceParams
from test_mono_gaussian_avatar import new_avatar
from toy_scene import toy_face


def moved_avatar() -> MonoGaussianAvatar:
    """An avatar whose networks all do something, and which is not in training mode."""
    avatar = new_avatar()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    avatar.eval()
    return avatar


def difference(avatar: MonoGaussianAvatar, face: FaceParams) -> float:
    """The largest difference of any property between the baked form and the networks."""
    baked = avatar.pose(face).gaussians
    avatar.train()
    own = avatar.pose(face).gaussians
    avatar.eval()
    names = ("means", "quats", "scales", "opacities", "sh", "T_world_local")
    pairs = [(getattr(baked, name), getattr(own, name)) for name in names]
    assert all(a.shape == b.shape for a, b in pairs)
    return max(float((a - b).detach().abs().max()) for a, b in pairs)


def test_the_baked_form_is_what_the_networks_give() -> None:
    avatar, face = moved_avatar(), toy_face(5)
    assert difference(avatar, face) < 1e-5
    assert not avatar.pose(face).gaussians.means.requires_grad
    with torch.no_grad():
        avatar.store["means"].mul_(0.9)
    assert difference(avatar, face) < 1e-5
    avatar.gaussian_store().select(torch.arange(3))
    assert avatar.pose(face).gaussians.means.shape == (5, 3, 3)


def test_it_is_baked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    avatar, face = moved_avatar(), toy_face(5)
    bake, calls = avatar.bake, []
    monkeypatch.setattr(avatar, "bake", lambda: (calls.append(0), bake())[1])
    avatar.pose(face[0])
    avatar.pose(face[1])
    assert len(calls) == 1


def test_networks_run_where_gradients_or_a_step_are_asked_for() -> None:
    avatar, face = moved_avatar(), toy_face(5)[0]
    wanted = replace(face, expression=face.expression.clone().requires_grad_())
    avatar.pose(wanted).gaussians.means.sum().backward()
    assert wanted.expression.grad is not None
    assert bool(wanted.expression.grad.any())
    assert avatar.pose(face, Progress(0, 10, 0, 1.0)).gaussians.means.requires_grad


def test_a_loaded_avatar_poses_its_baked_form(tmp_path: Path) -> None:
    avatar, face = moved_avatar(), toy_face(5)[2]
    write_avatar(tmp_path / "avatar", avatar)
    loaded = load_avatar(tmp_path / "avatar")
    assert isinstance(loaded, MonoGaussianAvatar)
    assert not loaded.training
    assert torch.equal(loaded.pose(face).gaussians.means, avatar.pose(face).gaussians.means)
    assert difference(loaded, face) < 1e-5
