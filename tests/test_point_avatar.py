"""PointAvatar follows its formulas: the schedule, light by normals, prunes of hidden points, and closed holes.

The network of points has the right softplus, and avatars with networks pose their baked form as numpy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import mono_avatars
from known import known
from mien import runtime
from mien.avatar import Avatar, load_avatar
from mien.avatar.files import write_avatar
from mien.avatar.headgas.avatar import HeadGas
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.mono_gaussian_avatar import motion
from mien.avatar.mono_gaussian_avatar.motion import nearest_vertices
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.avatar.ops.point_network import Activation, Layer, point_network, point_network_reference
from mien.avatar.point_avatar.avatar import PointAvatar, was_drawn
from mien.avatar.point_avatar.networks import SurfaceNet
from mien.avatar.point_avatar.settings import PointAvatarConfig
from mien.avatar.settings import Progress
from mien.face import FaceParams
from mien.face.posing import head_poses
from mien.gaussians import Gaussians
from mien.render import rasterize
from mien.render.rasterize import close_holes
from mien.runtime import posing
from mien.runtime.baked import BlendSkinned
from plain_settings import plain_mono_gaussian_avatar, plain_point_avatar
from refusals import refuses
from toy_scene import moved, random, rgb_from_sh, runtime_face, toy_camera, toy_face, toy_face_model

SMALL = plain_point_avatar(points=30, max_points=100, face_points=30)


def new_avatar(config: PointAvatarConfig = SMALL, disturbed: bool = True) -> PointAvatar:
    torch.manual_seed(0)
    avatar = PointAvatar(config, toy_face_model(), toy_face(5))
    if disturbed:
        with torch.no_grad():
            for parameter in avatar.parameters():
                parameter.add_(0.05 * torch.randn(parameter.shape))
    return avatar


def colors(avatar: PointAvatar, face: FaceParams) -> Tensor:
    return rgb_from_sh(avatar.pose(face).gaussians.sh)[..., 0, :]


def test_points_double_and_shrink_together() -> None:
    """They are round, opaque and of one size. Children are within the radius around their parents."""
    avatar = new_avatar()
    gaussians = avatar.pose(toy_face(5)[0], Progress(0, 100)).gaussians
    torch.testing.assert_close(gaussians.scales, torch.full((30, 3), 0.0375 * 0.75 ** np.log2(30 / 100) / 2))
    assert gaussians.opacities.unique().tolist() == [pytest.approx(0.99)]
    parents, noise = torch.tensor([3, 7]), torch.tensor([[0.5, -0.5, 0.0], [0.1, 0.2, 0.3]])
    children = avatar.density().refill(avatar.store, parents, noise, 0.0)["means"]
    torch.testing.assert_close(children - avatar.store["means"][parents], noise * avatar.radius(0.0))
    counts = [avatar.points_at((epoch + 0.5) / 20) for epoch in (0, 3, 4, 7, 8, 19)]
    assert counts == [30, 30, 60, 60, 100, 100]
    assert avatar.radius(0.25) == pytest.approx(0.75 * avatar.radius(0.1))
    settings = avatar.density().settings
    targets = dict(zip(settings.times, settings.targets, strict=True))
    assert len(targets) == 19
    # The round that ends epoch 3 already fills up to the number of epoch 4.
    assert (targets[3 / 20], targets[4 / 20], targets[19 / 20]) == (30, 60, 100)
    # In the paper's lengths, of a head of four times life size: 400 points of radius 0.15 * 0.75^2.
    avatar = new_avatar(replace(SMALL, points=400, max_points=100_000), disturbed=False)
    assert 4 * avatar.radius(0.0) == pytest.approx(0.15 * 0.75**2)
    torch.testing.assert_close(avatar.store["means"].norm(dim=-1), torch.full((400,), 0.125))


def test_slopes_are_the_gradients_of_the_distance_and_losses_hold_points_where_it_is_none() -> None:
    torch.manual_seed(0)
    network, points = SurfaceNet(16, 3, 2).double(), torch.randn(7, 3, dtype=torch.float64, requires_grad=True)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    found = network(points)
    torch.testing.assert_close(found.slope, torch.autograd.grad(found.distance.sum(), points)[0])
    avatar = new_avatar()
    posed = avatar.pose(toy_face(5)[1], Progress(4, 100))
    rendering = rasterize(posed.gaussians.timestep(0), toy_camera(32), torch.ones(3))
    losses = avatar.regularizers(posed, rendering, Progress(4, 100))
    surface = avatar.surface_net(avatar.store["means"].detach() / LENGTH_UNIT)
    torch.testing.assert_close(losses["distance"], surface.distance.square().mean())
    torch.testing.assert_close(losses["slope"], 0.1 * (surface.slope.norm(dim=-1) - 1).square().mean())
    assert set(losses) >= {"skinning", "expression_directions"}


def test_a_color_is_albedo_times_light_on_the_normal_which_turns_with_the_head() -> None:
    avatar = new_avatar()
    surface = avatar.surface_net(avatar.store["means"].detach() / LENGTH_UNIT)
    normals = torch.nn.functional.normalize(surface.slope, dim=-1)
    expected = surface.albedo.sigmoid() * avatar.shading(normals)
    torch.testing.assert_close(colors(avatar, toy_face(5)[2]), expected)
    assert new_avatar(disturbed=False).shading(normals).unique().tolist() == [1.0]
    avatar, still, face = new_avatar(replace(SMALL, normals="deformed")), new_avatar(), toy_face(5)[2]
    turned = replace(face, head_rotation=face.head_rotation + torch.tensor([0.0, 1.0, 0.0]))
    assert (colors(avatar, face) - colors(avatar, turned)).abs().max() > 1e-3
    refuses(r"^the setting normals deformed of point_avatar: .*export a \.ply", avatar.bake)
    torch.testing.assert_close(colors(still, face), colors(still, turned))
    # Points on rigid bones have normals that turn with them.
    last = avatar.deformation.skinning
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(10.0 * torch.eye(len(last.bias))[0])
    points, normals = avatar.store["means"].detach() / LENGTH_UNIT, torch.randn(30, 3)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    rest, now = (avatar.transforms(one)[0, 0, :, :3] for one in (avatar.canonical_face(), turned))
    expected = normals @ (head_poses(turned)[0, :3, :3] @ now @ rest.T).T
    torch.testing.assert_close(avatar.deformed_normals(points, normals, turned)[0], expected, atol=1e-5, rtol=0)


def test_points_that_others_hide_are_not_drawn() -> None:
    """A small point behind four large ones takes part in no pixel, but is within the picture."""
    camera = toy_camera(32)
    depths = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.8])
    means = (camera.position + depths[:, None] * camera.viewmat[2, :3]).requires_grad_()
    scales = torch.tensor([0.2, 0.2, 0.2, 0.2, 0.01])[:, None].repeat(1, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(5, 1)
    gaussians = Gaussians(means, quats, scales, torch.full((5,), 0.99), torch.zeros(5, 1, 3))
    rendering = rasterize(gaussians, camera, torch.ones(3))
    assert (rendering.radii > 0).all()
    (rendering.image * torch.linspace(0, 1, 32)[:, None]).sum().backward()
    seen = was_drawn(gaussians, rendering)
    assert (seen[0], seen[4]) == (1, 0)


def test_closing_fills_bright_specks_and_keeps_the_rest() -> None:
    picture = torch.ones(20, 20, 3)
    picture[5:15, 5:15] = 0.25
    whole = picture.clone()
    picture[9, 9] = 1.0
    picture[12:14, 6:8] = 1.0
    assert torch.equal(close_holes(picture, 1), whole)
    assert torch.equal(close_holes(picture, 0), picture)
    assert new_avatar().extras.closing == 1


def test_nearest_vertices_take_no_distances_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU there is a tree. Points are looked at in parts where there is none, as on a GPU."""
    random, sizes, addmm = torch.Generator().manual_seed(0), [], torch.addmm
    points, vertices = (torch.randn(n, 3, generator=random, dtype=torch.float64) for n in (1000, 50))
    monkeypatch.setattr(motion, "POINTS_AT_ONCE", 64)
    monkeypatch.setattr(torch, "addmm", lambda *args, **more: sizes.append(len(args[1])) or addmm(*args, **more))
    expected = (points[:, None] - vertices).norm(dim=-1).argmin(1)
    assert torch.equal(nearest_vertices(points, vertices), expected)
    assert max(sizes) == 64
    monkeypatch.delattr(torch, "addmm")
    points, vertices = points.float(), vertices.float()
    assert torch.equal(nearest_vertices(points, vertices), expected)
    points[0, 0] = float("nan")
    assert torch.equal(nearest_vertices(points, vertices)[1:], expected[1:])


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
        avatar = mono_avatars.new_avatar()
    moved(avatar, 0.02).eval()
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
    return mono_avatars.new_avatar(plain_mono_gaussian_avatar(points=points)).bake()


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
