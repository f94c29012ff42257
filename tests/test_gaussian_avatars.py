"""GaussianAvatars' formulas: triangle frames are right, and Gaussians stay on the surface, within limits."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from instruction_sets import by_threads
from known import known
from mien.avatar import GaussianAvatarsConfig
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars, never_empty_a_triangle
from mien.avatar.ops import surface_limits as limits
from mien.avatar.ops.bound_gaussians import pose_bound_gaussians, pose_bound_gaussians_reference
from mien.avatar.ops.skin_points import blend_transforms, unskin
from mien.avatar.ops.surface_limits import keep_on_surface, limits_of_triangles
from mien.avatar.ops.triangle_frames import DEGENERATE_LENGTH, bind_to_world, triangle_ellipses, triangle_frames
from mien.avatar.settings import Progress
from mien.avatar.store import GaussianStore
from mien.face import FaceModel, FaceParams
from mien.gaussians import Gaussians, world_means
from mien.render import rasterize
from mien.rotation import matrix_from_axis_angle, matrix_from_quaternion
from mien.runtime.checks import baked_fault
from mono_avatars import pictured
from plain_settings import plain_gaussian_avatars
from toy_scene import rgb_from_sh, surface_of, toy_camera, toy_face, toy_face_model


def new_avatar(config: GaussianAvatarsConfig | None = None, face_model: FaceModel | None = None) -> GaussianAvatars:
    torch.manual_seed(0)
    return GaussianAvatars(config or plain_gaussian_avatars(), face_model or toy_face_model(), toy_face(5))


def test_starts_with_one_gray_faint_gaussian_a_triangle() -> None:
    avatar, face = new_avatar(), toy_face(5)
    gaussians, model = avatar.pose(face).gaussians, avatar.face_model
    torch.testing.assert_close(world_means(gaussians), model(face)[:, model.faces].mean(-2), atol=1e-6, rtol=0)
    torch.testing.assert_close(gaussians.opacities, torch.full((len(model.faces),), 0.1))
    assert (rgb_from_sh(gaussians.sh) - 0.5).abs().max() < 0.002


def test_gaussians_that_shrink_to_nothing_have_a_record_and_those_that_grow_beyond_all_have_none() -> None:
    """The preset `paper` ends with a logarithm of -30.2."""
    avatar = new_avatar()
    sizes = avatar.store["log_scales"].detach().clone()
    avatar.store.assign("log_scales", sizes.index_fill(0, torch.tensor([1]), -40.0))
    assert baked_fault(avatar.bake()) is None
    avatar.store.assign("log_scales", sizes.index_fill(0, torch.tensor([1]), 40.0))
    assert "beyond exp(30)" in known(baked_fault(avatar.bake()))


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
    assert (counts, avatar.pose(face).gaussians.sh.shape[-2]) == ([1, 1, 4, 9, 16, 16], 16)
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
    shapes = {"means": (200, 3), "quats": (200, 4), "log_scales": (200, 3)}
    values = {name: torch.randn(shape) for name, shape in shapes.items()}
    store = GaussianStore(values, {"face_index": torch.arange(200) % 5})
    sizes = torch.tensor([0.001, 0.002, 0.004, 0.01, 0.1])
    table = limits_of_triangles(sizes, torch.full((5,), hair), torch.full((5,), widen))
    keep_on_surface(store, table)
    size = sizes[store["face_index"]]
    height, scales = store["means"][:, 1] * size, store["log_scales"].exp() * size[:, None]
    depth, thickness = widen * limits.DEPTH, widen * limits.THICKNESS
    assert (height <= depth + limits.HAIR_SHARE * hair + 1e-7).all()
    assert (height >= -depth - 1e-7).all()
    assert (height.abs() > 0.9 * depth).any()
    assert (scales[:, 1] <= thickness + limits.HAIR_THICKNESS * hair + 1e-7).all()
    flat = scales[:, [0, 2]]
    assert (flat <= limits.WIDTH + limits.HAIR_WIDTH * hair + 1e-7).all()
    assert (flat.amax(1) / flat.amin(1) <= limits.RATIO * 1.0001).all()
    # Needles grow wider, and do not take the longer side with them: training cannot hold what is thinner than a pixel.
    longer = values["log_scales"].exp()[:, [0, 2]].amax(1) * size
    torch.testing.assert_close(flat.amax(1), longer.clamp_max(limits.WIDTH + limits.HAIR_WIDTH * hair))
    normal = matrix_from_quaternion(torch.nn.functional.normalize(store["quats"], dim=1))[:, 1, 1]
    assert (normal >= math.cos(math.radians(widen * limits.TILT)) - 1e-5).all()
    before = {name: store[name].clone() for name in store.names()}
    keep_on_surface(store, table)
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


def random_rig(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return arguments of `bind_to_world`, at the size of a head."""
    generator = torch.Generator().manual_seed(0)
    vertices = 0.1 * torch.randn(20, 3, generator=generator, dtype=dtype)
    faces = torch.stack([torch.randperm(20, generator=generator)[:3] for _ in range(30)])
    face_index = torch.randint(0, 30, (100,), generator=generator)
    means = torch.randn(100, 3, generator=generator, dtype=dtype)
    quats = torch.randn(100, 4, generator=generator, dtype=dtype)
    log_scales = torch.randn(100, 3, generator=generator, dtype=dtype)
    return vertices, faces, face_index, means, quats, log_scales


def test_a_known_triangle_has_its_frame_and_a_gaussian_at_rest_takes_it():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0.5, 1, 0]])
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    # Columns: first edge (+x), normal (+z), their cross product (-y).
    torch.testing.assert_close(frames.R[0], torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    torch.testing.assert_close(frames.T[0], torch.tensor([2.5 / 3, 1 / 3, 0]))
    torch.testing.assert_close(frames.k[0], torch.tensor(1.5))
    # The native core uses each of the four quaternion formulas.
    vertices, faces, *_ = random_rig()
    frames, zeros = triangle_frames(vertices, faces), torch.zeros(30, 3)
    unit, bound = torch.tensor([3.0, 0, 0, 0]).expand(30, 4), torch.arange(30)
    for dtype, tolerance in ((torch.float64, 1e-7), (torch.float32, 2e-6)):
        local = (one.to(dtype) for one in (zeros, unit, zeros))
        means, quats, scales = (one.double() for one in bind_to_world(vertices.to(dtype), faces, bound, *local))
        torch.testing.assert_close(means, frames.T, atol=tolerance, rtol=0)
        torch.testing.assert_close(matrix_from_quaternion(quats), frames.R, atol=tolerance, rtol=0)
        torch.testing.assert_close(scales, frames.k[:, None].expand(-1, 3), atol=tolerance, rtol=0)
        assert set(quats.abs().argmax(-1).tolist()) == {0, 1, 2, 3}


def test_gaussians_follow_a_similarity_of_the_mesh():
    vertices, faces, *local = random_rig()
    rotation = matrix_from_axis_angle(torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64))
    shift = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    means, quats, scales = bind_to_world(vertices, faces, *local)
    moved_means, moved_quats, moved_scales = bind_to_world(2 * vertices @ rotation.T + shift, faces, *local)
    torch.testing.assert_close(moved_means, 2 * means @ rotation.T + shift)
    torch.testing.assert_close(matrix_from_quaternion(moved_quats), rotation @ matrix_from_quaternion(quats))
    torch.testing.assert_close(moved_scales, 2 * scales)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_triangles_stay_finite(dtype: torch.dtype):
    corners = [[0, 0, 0], [0, 0, 0], [1, 1, 1], [1e-9, 0, 0], [2, 2, 2], [1, 0, 0]]
    vertices = torch.tensor(corners, dtype=dtype, requires_grad=True)
    # A point, an edge without a length, collinear vertices, a sliver, and a sound one.
    faces = torch.tensor([[0, 0, 0], [0, 1, 2], [0, 2, 4], [0, 3, 2], [0, 5, 2]])
    local = [torch.randn(5, width, dtype=dtype, requires_grad=True) for width in (3, 4, 3)]
    found = triangle_frames(vertices, faces).k[:4]
    torch.testing.assert_close(found, torch.full_like(found, DEGENERATE_LENGTH))
    world = bind_to_world(vertices, faces, torch.arange(5), *local)
    loss = torch.cat([output.square().flatten() for output in world]).sum()
    gradients = torch.autograd.grad(loss, [vertices, *local])
    assert all(tensor.isfinite().all() for tensor in (*world, *gradients))
    assert gradients[0][5].abs().sum() > 0


def test_gradients_go_only_where_they_are_wanted_and_indices_are_checked():
    vertices, faces, face_index, *local = random_rig(dtype=torch.float32)
    local[0].requires_grad_()
    means, quats, scales = bind_to_world(vertices, faces, face_index, *local)
    assert torch.autograd.grad(quats.sum(), local[0], retain_graph=True)[0].abs().max() == 0
    assert torch.autograd.grad(means.sum() + scales.sum(), local[0])[0].abs().min() > 0
    with pytest.raises(IndexError, match="vertex"):
        bind_to_world(vertices, faces + 1, face_index, *local)
    with pytest.raises(IndexError, match="face"):
        bind_to_world(vertices, faces, face_index - 1, *local)


def test_unskin_undoes_blended_transforms() -> None:
    torch.manual_seed(0)
    face = replace(toy_face(5), joints=torch.randn(5, 1, 3))
    bones = toy_face_model().joint_transforms(face)[:, :, :3]
    transforms, points = blend_transforms(torch.rand(20, 3).softmax(-1), bones)[2], torch.randn(20, 3)
    moved = (transforms[:, :, :3] @ points[..., None])[..., 0] + transforms[..., 3]
    torch.testing.assert_close(unskin(moved, transforms), points, atol=1e-5, rtol=1e-5)


FACE_FIELDS = ("expression", "joints", "head_rotation", "head_translation")
STORED = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": ()}
COUNT = 20_000


def a_face(face_model: FaceModel) -> FaceParams:
    generator, neutral = torch.Generator().manual_seed(3), face_model.neutral(1)
    values = {
        name: (0.2 * torch.randn(getattr(neutral, name).shape, generator=generator)).requires_grad_()
        for name in FACE_FIELDS
    }
    return replace(neutral, **values)


def a_store(face_model: FaceModel) -> GaussianStore:
    generator = torch.Generator().manual_seed(4)
    trained = {name: torch.randn(COUNT, *shape, generator=generator) for name, shape in STORED.items()}
    face_index = torch.randint(len(face_model.faces), (COUNT,), generator=generator)
    return GaussianStore(trained | {"sh": torch.zeros(COUNT, 1, 3)}, {"face_index": face_index})


def results(gaussians: Gaussians, face: FaceParams, store: GaussianStore) -> list[Tensor]:
    """Return values, and gradients of a loss that weighs every number differently."""
    parts = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    parts += [] if gaussians.T_world_local is None else [gaussians.T_world_local]
    generator = torch.Generator().manual_seed(5)
    loss = torch.stack([(part * torch.randn(part.shape, generator=generator)).sum() for part in parts]).sum()
    inputs = [*(getattr(face, name) for name in FACE_FIELDS), *(store[name] for name in STORED)]
    return [*(part.detach() for part in parts), *torch.autograd.grad(loss, inputs)]


@pytest.mark.parametrize("in_head", [True, False])
def test_posing_in_one_call_equals_its_parts_to_the_bit(anny: FaceModel, in_head: bool) -> None:
    face, store = a_face(anny), a_store(anny)
    expected = results(pose_bound_gaussians_reference(anny, face, store, store["sh"], in_head), face, store)
    for native in by_threads(
        lambda: results(pose_bound_gaussians(anny, face, store, store["sh"], in_head), face, store)
    ):
        assert all(torch.equal(one, other) for one, other in zip(native, expected, strict=True))
        assert all(bool(tensor.abs().sum() > 0) for tensor in native)


def test_a_new_store_and_changed_indices_are_noticed(anny: FaceModel) -> None:
    """A fixed face gets no gradient."""
    face, store = a_face(anny).detach(), a_store(anny)

    def posed() -> Gaussians:
        return pose_bound_gaussians(anny, face, store, store["sh"], in_head=True)

    before = posed()
    torch.testing.assert_close(before.T_world_local, face.T_world_head[0])
    assert torch.autograd.grad(before.means.sum(), store["means"])[0].any()
    store["face_index"].copy_(store["face_index"].flip(0))
    expected = pose_bound_gaussians_reference(anny, face, store, store["sh"], in_head=True).means
    assert torch.equal(posed().means, expected)
    assert not torch.equal(posed().means, before.means)
    store.select(torch.arange(100))
    assert posed().means.shape == (100, 3)
    store["face_index"][0] = len(anny.faces)
    with pytest.raises(IndexError, match="face"):
        posed()
