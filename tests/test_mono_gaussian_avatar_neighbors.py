"""MonoGaussianAvatar finds the vertices nearest to its points, in little memory."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mien.avatar import Progress
from mien.avatar.mono_gaussian_avatar import motion
from mien.avatar.mono_gaussian_avatar.motion import nearest_vertices
from mono_avatars import new_avatar, pictured
from plain_settings import plain_mono_gaussian_avatar
from toy_scene import toy_face, toy_face_model


def test_nearest_vertices() -> None:
    """Each point finds its nearest vertex."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = torch.tensor([[0.6, 0.1, 0], [0.1, 0.1, 5], [0.4, 0.55, 0]])
    assert nearest_vertices(points, vertices).tolist() == [1, 0, 2]
    assert nearest_vertices(points.double(), vertices.double()).tolist() == [1, 0, 2]


def test_nearest_vertices_on_a_cpu_take_no_distances_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    random = torch.Generator().manual_seed(0)
    points, vertices = torch.randn(1000, 3, generator=random), torch.randn(50, 3, generator=random)
    expected = (points[:, None] - vertices).norm(dim=-1).argmin(1)
    monkeypatch.delattr(torch, "addmm")
    assert torch.equal(nearest_vertices(points, vertices), expected)
    points[0, 0] = float("nan")
    assert torch.equal(nearest_vertices(points, vertices)[1:], expected[1:])


def test_nearest_vertices_of_many_points_take_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points are looked at in parts where there is no tree, as on a GPU."""
    random = torch.Generator().manual_seed(0)
    points, vertices = (torch.randn(n, 3, generator=random, dtype=torch.float64) for n in (1000, 50))
    monkeypatch.setattr(motion, "_POINTS_AT_ONCE", 64)
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
