"""GaussianAvatars' formulas."""

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.avatar import GaussianAvatars, GaussianAvatarsConfig, GaussianStore, Progress
from mien.avatar.gaussian_avatars.avatar import (
    never_empty_a_triangle,
)
from mien.avatar.ops.triangle_penalties import triangle_penalties, triangle_penalties_reference
from mien.face import FaceModel
from mien.gaussians import world_means
from mien.render import rasterize
from mien.render.rendering import Rendering
from plain_settings import plain_gaussian_avatars
from sh_colors import rgb_from_sh
from toy_scene import surface_of, toy_camera, toy_face, toy_face_model


def new_avatar(config: GaussianAvatarsConfig | None = None, face_model: FaceModel | None = None) -> GaussianAvatars:
    torch.manual_seed(0)
    return GaussianAvatars(config or plain_gaussian_avatars(), face_model or toy_face_model(), toy_face(5))


def rendering_of(radii: torch.Tensor) -> Rendering:
    return Rendering(torch.zeros(4, 4, 3), torch.zeros(4, 4), radii.int(), torch.zeros(len(radii), 2))


def test_starts_with_one_gray_faint_gaussian_a_triangle() -> None:
    avatar = new_avatar()
    face_model = avatar.face_model
    gaussians = avatar.pose(toy_face(5)).gaussians
    assert len(gaussians) == len(face_model.faces)
    centroids = face_model(toy_face(5))[:, face_model.faces].mean(-2)
    torch.testing.assert_close(world_means(gaussians), centroids, atol=1e-6, rtol=0)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(gaussians),), 0.1))
    assert (rgb_from_sh(gaussians.sh) - 0.5).abs().max() < 0.002


def test_first_colors_are_the_means_of_the_triangles_corners() -> None:
    """Every Gaussian gets its own triangle's colour, also if the Gaussians are in another order than the triangles."""
    avatar = new_avatar(plain_gaussian_avatars(sh_degree=1, first_colors="pictures"))
    assert surface_of(avatar).wants_first_colors
    assert not surface_of(new_avatar()).wants_first_colors
    avatar.store.select(torch.arange(len(avatar.store)).flip(0)[:20])
    colors = torch.rand(len(avatar.face_model.template), 3)
    surface_of(avatar).set_first_colors(colors)
    expected = colors[avatar.face_model.faces.flip(0)[:20]].mean(1)
    torch.testing.assert_close(rgb_from_sh(avatar.store["sh_constant"][:, 0]), expected)
    assert not avatar.store["sh_rest"].any()


def test_losses_are_those_of_the_paper() -> None:
    avatar = new_avatar()
    store, n = avatar.store, len(avatar.store)
    with torch.no_grad():
        store["means"].zero_()
        store["means"][0] = torch.tensor([0.0, 3.0, 4.0])
        store["means"][1] = torch.tensor([0.0, 0.0, 0.9])
        store["means"][2] = torch.tensor([100.0, 0.0, 0.0])
        store["log_scales"].fill_(-3)
        store["log_scales"][0] = torch.tensor([0.6 + 3.0, 0.6 + 4.0, 0.5]).log()
        store["log_scales"][2] = 10
    radii = torch.ones(n)
    radii[2] = 0
    losses = avatar.regularizers(avatar.pose(toy_face(5)[0]), rendering_of(radii), Progress(0, 1))
    # Means over the n - 1 visible Gaussians; the third, which is out of bounds, is not in view.
    assert losses["position"].item() == pytest.approx(0.01 * (5 - 1) / (n - 1), rel=1e-5)
    assert losses["scale"].item() == pytest.approx(1.0 * 5 / (n - 1), rel=1e-5)


def test_losses_are_finite_when_nothing_is_in_view() -> None:
    avatar = new_avatar()
    losses = avatar.regularizers(
        avatar.pose(toy_face(5)[0]), rendering_of(torch.zeros(len(avatar.store))), Progress(0, 1)
    )
    assert [loss.item() for loss in losses.values()] == [0, 0]


def test_sh_degrees_are_switched_on_one_after_the_other() -> None:
    avatar = new_avatar(plain_gaussian_avatars(sh_degree=3, sh_warmup=0.4))
    counts = [
        avatar.pose(toy_face(5)[0], Progress(step, 100)).gaussians.sh.shape[-2] for step in (0, 9, 10, 20, 31, 99)
    ]
    assert counts == [1, 1, 4, 9, 16, 16]
    assert avatar.pose(toy_face(5)[0]).gaussians.sh.shape[-2] == 16


def test_head_frame_sees_the_same_picture_but_for_the_light() -> None:
    world, head = (new_avatar(plain_gaussian_avatars(sh_frame=frame)) for frame in ("world", "head"))
    face = toy_face(5)[1]
    pictures = [
        rasterize(a.pose(face).gaussians.timestep(0), toy_camera(32), torch.ones(3)).image for a in (world, head)
    ]
    torch.testing.assert_close(*pictures, atol=2e-4, rtol=0)


def test_no_triangle_is_emptied() -> None:
    faces = torch.tensor([7, 7, 8, 8, 8])
    store = GaussianStore({"means": torch.zeros(5, 3)}, {"face_index": faces})
    prune = torch.tensor([True, True, True, False, True])
    assert never_empty_a_triangle(store, prune).tolist() == [False, False, True, False, True]
    assert new_avatar().density().may_prune is never_empty_a_triangle


def random(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", [0, 1, 15, 16, 4097])
def test_triangle_penalties_equal_their_reference(isa: str, count: int) -> None:
    means, log_scales = random(count, 3), random(count, 3, seed=1)
    means[:2] = 0  # whose length has no derivative
    radii = torch.randint(0, 3, (count,), generator=torch.Generator().manual_seed(2), dtype=torch.int32)
    results = []
    for function, dtype in ((triangle_penalties, torch.float32), (triangle_penalties_reference, torch.float64)):
        inputs = [tensor.to(dtype).requires_grad_() for tensor in (means, log_scales)]
        position, scale = function(inputs[0], inputs[1], radii, thresholds=(1.0, 0.6), weights=(0.5, 2.0))
        gradients = torch.autograd.grad(3 * position + scale, inputs)
        results.append([tensor.double() for tensor in (position, scale, *gradients)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-7)


def test_penalties_have_the_same_bits_for_any_number_of_threads() -> None:
    means, log_scales, radii = random(20_000, 3), random(20_000, 3, seed=1), torch.ones(20_000, dtype=torch.int32)
    before, results = _native.thread_count(), []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        inputs = [tensor.clone().requires_grad_() for tensor in (means, log_scales)]
        position, scale = triangle_penalties(inputs[0], inputs[1], radii, thresholds=(1.0, 0.6), weights=(0.5, 2.0))
        results.append((position, scale, *torch.autograd.grad(position + scale, inputs)))
    _native.set_thread_count(before)
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))
