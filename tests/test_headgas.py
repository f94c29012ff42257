"""HeadGaS and its ablations follow their formulas. tests/test_methods.py trains, saves and bakes them."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from torch import Tensor

from known import known
from mien.adam import FactoredMoments, Moments
from mien.avatar.baking import make_portable
from mien.avatar.headgas.avatar import HeadGas, input_directions, neighbor_distances, spread_out
from mien.avatar.headgas.settings import HeadGasConfig, Variant
from mien.avatar.headgas.variants import MOVED, SHIFT_LENGTH, averaging_weights
from mien.avatar.methods import method_named
from mien.avatar.ops.binding import squared_distances
from mien.avatar.ops.points import positional_encoding, sample_surface
from mien.avatar.ops.regions import region_shares
from mien.avatar.resting import neutral_of
from mien.avatar.settings import Progress
from mien.errors import UserError
from mien.face import FaceModel, FaceParams, load_face_model
from mien.face.posing import head_poses
from mien.pipeline.view import mesh_of
from mien.render import rasterize
from mien.rotation import matrix_from_quaternion
from mien.runtime import pose, read_portable, write_portable
from mien.training import PRESETS
from mien.training.adam import Adam
from test_feature_network import product
from toy_scene import moved, runtime_face, toy_camera, toy_face, toy_face_model

SMALL = HeadGasConfig(
    points=40, features=5, directions=0, sh_degree=1, sh_warmup=0.0, sh_higher_share=1.0, judged_expressions=0
)

REGIONS = replace(SMALL, activations="regions", directions=9, sh_degree=0)


def new_avatar(config: HeadGasConfig = SMALL, face_model: FaceModel | None = None) -> HeadGas:
    torch.manual_seed(0)
    return HeadGas(config, face_model or toy_face_model(), toy_face(5))


def fill(avatar: HeadGas, *names: str) -> None:
    for seed, name in enumerate(names or ("bases", "neutral_features"), 1):
        values = torch.randn(avatar.store[name].shape, generator=torch.Generator().manual_seed(seed))
        avatar.store.assign(name, values)


def inputs_of(face: FaceParams) -> Tensor:
    return torch.cat([face.expression, face.joints.reshape(len(face), -1)], dim=-1)


def blended(avatar: HeadGas, face: FaceParams) -> Tensor:
    """The features [b, n, f] by the formula."""
    return avatar.store["neutral_features"] + torch.einsum("bk,nkf->bnf", directed(avatar, face), avatar.store["bases"])


def test_directions_are_the_inputs_themselves_in_paper_and_else_the_largest_spread() -> None:
    face = toy_face(50)
    own, inputs = input_directions(face, neutral_of(face), 0)
    assert (bool(own.any()), inputs.tolist()) == (False, torch.eye(5).tolist())
    (rest, every), (_, two) = (input_directions(face, neutral_of(face), count) for count in (9, 2))
    assert torch.equal(rest, inputs_of(neutral_of(face))[0])
    # Two angles never change and the third follows an expression, so three directions are 0. The others lose nothing.
    assert torch.equal(every, torch.nn.functional.pad(two, (0, 3)))
    offsets = inputs_of(face) - inputs_of(face).mean(0)
    assert float((offsets @ every).std(0).max()) == pytest.approx(1, abs=0.05)
    torch.testing.assert_close(offsets @ two @ torch.linalg.pinv(two), offsets)


def test_color_and_opacity_are_the_networks_of_features_and_place() -> None:
    avatar, face = new_avatar(replace(SMALL, directions=3)), toy_face(5)[2]
    assert not directed(avatar, avatar.subject).any()
    avatar = new_avatar()
    fill(avatar)
    assert torch.equal(directed(avatar, face), inputs_of(face)), "as in the paper"
    gaussians = avatar.pose(face).gaussians
    assert torch.equal(known(gaussians.T_world_local), head_poses(face))
    first, _, last = avatar.network
    assert isinstance(first, torch.nn.Linear)
    assert isinstance(last, torch.nn.Linear)
    values = first(torch.cat([blended(avatar, face)[0], encoding_of(avatar)], dim=-1))
    values = last(torch.where(values < 0, 0.01 * values, values))
    torch.testing.assert_close(gaussians.sh[0], values[:, :12].reshape(40, 4, 3))
    torch.testing.assert_close(gaussians.opacities[0], values[:, 12].sigmoid())


def test_bases_may_be_trained_by_adam_and_centres_through_their_encoding() -> None:
    groups = {group.name: group for group in new_avatar(replace(SMALL, network_epsilon=1e-8)).parameter_groups()}
    assert (groups["network"].epsilon, groups["means"].epsilon) == (1e-8, 1e-15)
    moved, by_bases = [], []
    for encoding_gradient, factored_bases in ((False, True), (True, True), (False, False), (True, False)):
        avatar = new_avatar(replace(SMALL, encoding_gradient=encoding_gradient, factored_bases=factored_bases))
        fill(avatar)
        gaussians = avatar.pose(toy_face(5)[2]).gaussians
        (gaussians.opacities.sum() + gaussians.sh.square().sum()).backward()
        assert (avatar.store["means"].grad is not None) == encoding_gradient
        moved += [avatar.store["means"].grad] if encoding_gradient else []
        (group,) = [group for group in avatar.parameter_groups() if group.name == "bases"]
        if not factored_bases:
            by_bases += [product(*term) for term in group.factored["bases"].terms]
        before = avatar.store["bases"].detach().clone()
        Adam().step([group], Progress(0, 100))
        assert not before.equal(avatar.store["bases"])
        assert isinstance(avatar.store.moments["bases"], FactoredMoments if factored_bases else Moments)
    assert moved[0].abs().min() > 0
    torch.testing.assert_close(*moved)
    assert by_bases[0].abs().max() > 0
    torch.testing.assert_close(*by_bases)


def test_children_of_a_split_copy_features_and_opacity_has_no_reset() -> None:
    avatar, parents = new_avatar(REGIONS), torch.tensor([3, 3, 9])
    fill(avatar)
    density = avatar.density()
    avatar.store.append(parents, density.split(avatar.store, parents, torch.randn(3, 3)))
    for name in ("bases", "neutral_features", "face_index", "means"):
        assert torch.equal(avatar.store[name][-3:], avatar.store[name][parents]) == (name != "means")
    assert density.opacity_logits is None
    for preset in method_named("headgas").presets:
        config: Any = PRESETS[preset].config("headgas")
        assert config.density.opacity_resets == ()


def test_brows_do_not_follow_the_mouth_with_regions_nor_in_files(tmp_path: Path) -> None:
    model = load_face_model("anny")
    rest, generator = model.neutral(20), torch.Generator().manual_seed(3)
    random = torch.rand(rest.expression.shape, generator=generator), 0.2 * torch.randn(20, 3, generator=generator)
    face = replace(rest, expression=random[0], head_rotation=random[1])
    mouth = torch.eye(len(model.expression_names))[model.expression_names.index("mouthLowerDownLeft")]
    faces = [face[2], replace(face[2], expression=face[2].expression + mouth)]
    faces += [replace(face[2], head_rotation=face[2].head_rotation + 0.2)]
    still = {}
    for activations in ("whole", "regions"):
        torch.manual_seed(0)
        avatar = HeadGas(replace(REGIONS, points=4000, activations=activations), model, face)
        fill(avatar)
        store, vertices = avatar.store, model.head_vertices(avatar.subject)[0]
        before, after, turned = (avatar.pose(one).gaussians for one in faces)
        still[activations] = (before.sh == after.sh)[0].flatten(1).all(1)
    corners = vertices[model.faces[store["face_index"]]]
    torch.testing.assert_close(squared_distances(store["means"], corners), torch.zeros(4000), rtol=0, atol=1e-12)
    shares = region_shares(model, avatar.subject)[model.faces][store["face_index"]].mean(1)
    brows = (shares[:, 2:] == 0).all(1)
    assert (int(brows.sum()) > 9, bool(still["whole"].any())) == (True, False)
    assert (bool(still["regions"][brows].all()), bool(still["regions"][shares[:, 4] > 0.1].any())) == (True, False)
    assert not (before.sh == turned.sh)[0].flatten(1).all(1).any(), "with the head's pose, all change"
    write_portable(tmp_path / "a.mien", portable := make_portable(avatar, toy_camera(32), "toy"))
    baked = read_portable(tmp_path / "a.mien").baked
    assert mesh_of(portable) is None, "nothing is bound to the person's mesh"
    for one, trained in zip(faces, (before, after, turned), strict=True):
        found = pose(baked, runtime_face(one))
        assert torch.equal(torch.from_numpy(found.sh), trained.sh[0])
        assert torch.equal(torch.from_numpy(found.opacities), trained.opacities[0])
        torch.testing.assert_close(torch.from_numpy(found.means), trained.means.expand(4000, 3), rtol=0, atol=1e-6)
    for other in ({"variant": "delta"}, {"directions": 0}, {"sh_degree": 1}):
        assert new_avatar(replace(REGIONS, **other)).activations is None


def test_higher_degrees_learn_slower_and_begin_later() -> None:
    config = replace(SMALL, sh_degree=3, sh_warmup=0.4, sh_higher_share=0.05)
    avatar, face = new_avatar(config), toy_face(5)[1]
    for parameter in avatar.network.parameters():
        torch.nn.init.normal_(parameter)
    full = avatar.pose(face).gaussians.sh[0]
    for step, active in ((0, 1), (99, 1), (100, 4), (200, 9), (301, 16), (1000, 16)):
        sh = avatar.pose(face, Progress(step, 1000)).gaussians.sh[0]
        torch.testing.assert_close(sh, torch.where(torch.arange(16)[:, None] < active, full, 0))
    plain = new_avatar(replace(config, sh_higher_share=1.0))
    plain.load_state_dict(avatar.state_dict())
    share = torch.where(torch.arange(16)[:, None] < 1, 1, 0.05)
    torch.testing.assert_close(full, share * plain.pose(face).gaussians.sh[0])
    torch.testing.assert_close(torch.from_numpy(pose(avatar.bake(), runtime_face(face)).sh), full)


def test_points_are_on_the_mesh_evenly_by_area_and_know_their_neighbors() -> None:
    # A large triangle in z = 0 and one with a ninth of its area in z = 1.
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    torch.manual_seed(0)
    points = sample_surface(vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]), 4000)
    large = points[:, 2] == 0
    assert abs(large.float().mean() - 0.9) < 0.02
    assert (points[:, :2] >= 0).all()
    assert (points[large, :2].sum(-1) <= 3.0001).all()
    torch.testing.assert_close(points[large, :2].mean(0), torch.ones(2), atol=0.05, rtol=0)
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [10, 0, 0]])
    expected = torch.tensor([2.0, (9 + 10 + 104**0.5) / 3])
    torch.testing.assert_close(neighbor_distances(points)[[0, 4]], expected)
    points = torch.tensor([[0.0, 0], [0.1, 0], [5, 0], [0, 1], [5.1, 0], [0.1, 0.1]])
    assert [len(spread_out(points, count)) for count in (0, 3, 100)] == [0, 3, 6]
    assert spread_out(points, 3) == [4, 3, 1], "judged expressions are far from each other"
    point = torch.tensor([0.1, -0.2, 0.3])
    waves = [wave(octave * point) for octave in (1, 2, 4) for wave in (torch.sin, torch.cos)]
    torch.testing.assert_close(positional_encoding(point, 3), torch.cat([point, *waves]))


VARIANT = HeadGasConfig(points=40, features=5, hidden=8, sh_degree=1, sh_warmup=0.0)


def new_variant(variant: Variant, disturbed: bool = True) -> HeadGas:
    avatar = new_avatar(replace(VARIANT, variant=variant))
    if disturbed:
        moved(avatar, 0.1, but="means")
    return avatar


def encoding_of(avatar: HeadGas) -> Tensor:
    return positional_encoding(avatar.store["means"].detach() / SMALL.encoding_length, SMALL.encoding_bands)


def network_inputs(avatar: HeadGas) -> Tensor:
    """Features and place of each point at the third timestep."""
    return torch.cat([blended(avatar, toy_face(5)[2])[0], encoding_of(avatar)], dim=-1)


def directed(avatar: HeadGas, face: FaceParams) -> Tensor:
    """Inputs along the directions."""
    return (inputs_of(face) - avatar.rest) @ avatar.directions


@pytest.mark.parametrize("variant", get_args(Variant))
def test_starts_faint_gray_and_still_and_is_judged_as_it_is_drawn(variant: Variant) -> None:
    avatar, face = new_variant(variant, disturbed=False), toy_face(5)
    gaussians = avatar.pose(face).gaussians
    assert (gaussians.opacities - (0.5 if variant == "no_blending" else 0.1)).abs().max() < 0.1
    assert gaussians.sh.abs().max() < 1
    torch.testing.assert_close(gaussians.means.expand(5, 40, 3), avatar.store["means"].expand(5, 40, 3))
    assert variant != "full" or torch.equal(gaussians.sh[0], gaussians.sh[3])
    avatar = new_variant(variant)
    expected = avatar.pose(face).gaussians.opacities.expand(5, 40).amax(0).detach()
    judged = avatar.density().judged_opacities
    assert judged is not None
    torch.testing.assert_close(judged(avatar.store, torch.zeros(40)), expected)
    assert torch.equal(judged(avatar.store, torch.ones(40)), torch.ones(40))


def test_delta_moves_and_turns_by_the_network_and_paints_nothing() -> None:
    """Eq. 1 to 4 of the supplement, where the rotation comes before that of the Gaussian itself."""
    avatar, face = new_variant("delta"), toy_face(5)
    posed, moved, store = avatar.pose(face), avatar.network(network_inputs(avatar)), avatar.store
    assert moved.shape == (40, MOVED)
    found = posed.gaussians.timestep(2)
    torch.testing.assert_close(found.means, store["means"] + SHIFT_LENGTH * moved[:, :3])
    turn = matrix_from_quaternion(moved[:, 3:] + torch.tensor([1.0, 0, 0, 0]))
    torch.testing.assert_close(matrix_from_quaternion(found.quats), turn @ matrix_from_quaternion(store["quats"]))
    torch.testing.assert_close(found.opacities, store["opacity_logits"].sigmoid())
    share = torch.tensor([1.0, *[VARIANT.sh_higher_share] * 3])[:, None]
    torch.testing.assert_close(found.sh, share * store["sh"])
    shifts = (posed.gaussians.means - store["means"]).detach()
    assert float(shifts.abs().max()) > 1e-4
    losses = avatar.regularizers(posed, rasterize(found, toy_camera(32), torch.ones(3)), Progress(1, 2))
    torch.testing.assert_close(losses["shift"], VARIANT.shift_weight * shifts.abs().mean(), atol=1e-7, rtol=1e-4)


def test_change_all_paints_too() -> None:
    avatar, face = new_variant("change_all"), toy_face(5)
    posed = avatar.pose(face)
    outputs, found = avatar.network(network_inputs(avatar)), posed.gaussians.timestep(2)
    assert outputs.shape == (40, 12 + MOVED + 1)
    torch.testing.assert_close(found.sh[:, 0], outputs[:, :3])
    torch.testing.assert_close(found.means, avatar.store["means"] + SHIFT_LENGTH * outputs[:, 12:15])
    torch.testing.assert_close(found.opacities, outputs[:, -1].sigmoid())
    assert set(avatar.regularizers(posed, rasterize(found, toy_camera(32), torch.ones(3)), Progress(1, 2))) == {"shift"}


def test_no_mlp_averages_colors_and_opacities_by_expression_weights() -> None:
    """Also in `standard`, whose other variants have directions."""
    avatar, face = new_variant("no_mlp"), toy_face(5)[2]
    weights = inputs_of(face)[0] / inputs_of(face).sum()
    found, store = avatar.pose(face).gaussians.timestep(0), avatar.store
    torch.testing.assert_close(found.sh[:, 0], torch.einsum("nko,k->no", store["bases"], weights)[:, :3])
    torch.testing.assert_close(found.opacities, store["opacity_logits"].sigmoid() @ weights)
    assert len(list(avatar.network.parameters())) == 0
    assert set(store.names()) == {"means", "quats", "log_scales", "bases", "opacity_logits"}
    for inputs, expected in (
        ([0.5, 0, 0.25], [2 / 3, 0, 1 / 3]), ([2, -2, 1], [2, -2, 1]), ([-1, -1, 0], [0.5, 0.5, 0]),
        ([0, 0, 0], [1 / 3] * 3), ([1, -1, 0.05], [61 / 6, -59 / 6, 4 / 6]),  # sums nearer to 0 than 0.1
    ):  # fmt: skip
        torch.testing.assert_close(averaging_weights(torch.tensor(inputs).float()), torch.tensor(expected).float())


def test_no_blending_gives_the_expression_to_five_layers() -> None:
    avatar, face = new_variant("no_blending"), toy_face(5)[2]
    outputs = avatar.network(torch.cat([directed(avatar, face).expand(40, -1), encoding_of(avatar)], dim=-1))
    found = avatar.pose(face).gaussians.timestep(0)
    torch.testing.assert_close(found.sh[:, 0], outputs[:, :3])
    torch.testing.assert_close(found.opacities, outputs[:, -1].sigmoid())
    assert [type(layer) for layer in avatar.network] == [torch.nn.Linear, torch.nn.LeakyReLU] * 5
    assert (outputs < 0).any(), "the last one acts"
    assert set(avatar.store.names()) == {"means", "quats", "log_scales"}


@pytest.mark.parametrize("variant", ["no_mlp", "delta", "change_all"])
def test_what_cannot_be_baked_says_so_in_one_line(variant: Variant) -> None:
    with pytest.raises(UserError, match=rf"^the variant {variant} of headgas: [^\n]*export a \.ply[^\n]*$"):
        make_portable(new_variant(variant), toy_camera(32), "toy")
