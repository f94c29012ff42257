"""GaussianAvatars' formulas. Gaussians stay on the surface, within limits to their place, size and tilt."""

import math
from dataclasses import replace

import pytest
import torch

from mien.avatar import GaussianAvatars, GaussianAvatarsConfig, GaussianStore, Progress
from mien.avatar.gaussian_avatars.avatar import never_empty_a_triangle
from mien.avatar.gaussian_avatars.settings import SurfaceLimits
from mien.avatar.gaussian_avatars.surface_limits import keep_on_surface, limits_of_triangles
from mien.avatar.ops.triangle_frames import bind_to_world, triangle_ellipses
from mien.face import FaceModel
from mien.gaussians import world_means
from mien.render import rasterize
from mien.rotation import matrix_from_quaternion
from mono_avatars import pictured
from plain_settings import plain_gaussian_avatars
from sh_colors import rgb_from_sh
from toy_scene import surface_of, toy_camera, toy_face, toy_face_model


def new_avatar(config: GaussianAvatarsConfig | None = None, face_model: FaceModel | None = None) -> GaussianAvatars:
    torch.manual_seed(0)
    return GaussianAvatars(config or plain_gaussian_avatars(), face_model or toy_face_model(), toy_face(5))


def test_starts_with_one_gray_faint_gaussian_a_triangle() -> None:
    avatar, face = new_avatar(), toy_face(5)
    gaussians, model = avatar.pose(face).gaussians, avatar.face_model
    torch.testing.assert_close(world_means(gaussians), model(face)[:, model.faces].mean(-2), atol=1e-6, rtol=0)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(model.faces),), 0.1))
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
    avatar, face = new_avatar(), toy_face(5)[0]
    store, n = avatar.store, len(avatar.store)
    with torch.no_grad():
        store["means"].zero_()
        store["means"][:3] = torch.tensor([[0.0, 3.0, 4.0], [0.0, 0.0, 0.9], [100.0, 0.0, 0.0]])
        store["log_scales"].fill_(-3)
        store["log_scales"][0] = torch.tensor([0.6 + 3.0, 0.6 + 4.0, 0.5]).log()
        store["log_scales"][2] = 10
    # Means over the n - 1 visible Gaussians; the third, which is out of bounds, is not in view. Then nothing is.
    for radii, position, scale in (
        (1 - torch.eye(n)[2], 0.01 * (5 - 1) / (n - 1), 1.0 * 5 / (n - 1)),
        (torch.zeros(n), 0, 0),
    ):
        rendering = replace(pictured(n), radii=radii.int())
        losses = avatar.regularizers(avatar.pose(face), rendering, Progress(0, 1))
        assert [losses[name].item() for name in ("position", "scale")] == pytest.approx([position, scale], rel=1e-5)


def test_sh_degrees_are_switched_on_one_after_the_other_and_may_turn_with_the_head() -> None:
    avatar, face = new_avatar(plain_gaussian_avatars(sh_degree=3, sh_warmup=0.4)), toy_face(5)[0]
    counts = [avatar.pose(face, Progress(step, 100)).gaussians.sh.shape[-2] for step in (0, 9, 10, 20, 31, 99)]
    assert counts == [1, 1, 4, 9, 16, 16]
    assert avatar.pose(face).gaussians.sh.shape[-2] == 16
    avatars = (new_avatar(plain_gaussian_avatars(sh_frame=frame)) for frame in ("world", "head"))
    drawn = (avatar.pose(toy_face(5)[1]).gaussians.timestep(0) for avatar in avatars)
    pictures = [rasterize(gaussians, toy_camera(32), torch.ones(3)).image for gaussians in drawn]
    torch.testing.assert_close(*pictures, atol=2e-4, rtol=0)


def test_no_triangle_is_emptied() -> None:
    faces = torch.tensor([7, 7, 8, 8, 8])
    store = GaussianStore({"means": torch.zeros(5, 3)}, {"face_index": faces})
    prune = torch.tensor([True, True, True, False, True])
    assert never_empty_a_triangle(store, prune).tolist() == [False, False, True, False, True]
    assert new_avatar().density().may_prune is never_empty_a_triangle


@pytest.mark.parametrize(("hair", "widen"), [(0.0, 1.0), (0.01, 1.0), (0.0, 2.0)])
def test_limits_keep_gaussians_on_the_surface(hair: float, widen: float) -> None:
    torch.manual_seed(0)
    limits, shapes = SurfaceLimits(enabled=True), {"means": (200, 3), "quats": (200, 4), "log_scales": (200, 3)}
    values = {name: torch.randn(shape) for name, shape in shapes.items()}
    store = GaussianStore(values, {"face_index": torch.arange(200) % 5})
    sizes = torch.tensor([0.001, 0.002, 0.004, 0.01, 0.1])
    table = limits_of_triangles(limits, sizes, torch.full((5,), hair), torch.full((5,), widen))
    keep_on_surface(store, table, limits.ratio)
    size = sizes[store["face_index"]]
    height, scales = store["means"][:, 1] * size, store["log_scales"].exp() * size[:, None]
    depth, thickness = widen * limits.depth, widen * limits.thickness
    assert (height <= depth + limits.hair_share * hair + 1e-7).all()
    assert (height >= -depth - 1e-7).all()
    assert (height.abs() > 0.9 * depth).any()
    assert (scales[:, 1] <= thickness + limits.hair_thickness * hair + 1e-7).all()
    flat = scales[:, [0, 2]]
    assert (flat <= limits.width + limits.hair_width * hair + 1e-7).all()
    assert (flat.amax(1) / flat.amin(1) <= limits.ratio * 1.0001).all()
    # Needles grow wider, and do not take the longer side with them: training cannot hold what is thinner than a pixel.
    longer = values["log_scales"].exp()[:, [0, 2]].amax(1) * size
    torch.testing.assert_close(flat.amax(1), longer.clamp_max(limits.width + limits.hair_width * hair))
    normal = matrix_from_quaternion(torch.nn.functional.normalize(store["quats"], dim=1))[:, 1, 1]
    assert (normal >= math.cos(math.radians(widen * limits.tilt)) - 1e-5).all()
    before = {name: store[name].clone() for name in store.names()}
    keep_on_surface(store, table, limits.ratio)
    for name, value in before.items():
        torch.testing.assert_close(store[name], value)


def test_ellipses_have_the_moments_of_their_triangles() -> None:
    torch.manual_seed(0)
    vertices, faces = torch.randn(9, 3), torch.arange(9).view(3, 3)
    quats, log_scales = triangle_ellipses(vertices, faces)
    _, world, scales = bind_to_world(vertices[None], faces, torch.arange(3), torch.zeros(3, 3), quats, log_scales)
    rotation = matrix_from_quaternion(world[0])
    found = rotation @ torch.diag_embed(scales[0] ** 2) @ rotation.mT
    corners = vertices[faces] - vertices[faces].mean(1, keepdim=True)
    expected = 2.0**2 / 12 * torch.einsum("fci,fcj->fij", corners, corners)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / normal.norm(dim=-1, keepdim=True)
    thin = torch.einsum("f,fi,fj->fij", scales[0].amin(-1) ** 2, normal, normal)
    torch.testing.assert_close(found, expected + thin, atol=1e-4, rtol=1e-3)
