"""Changes of gaussian_avatars with the expression: their formulas, and what of them is kept and refused.
`test_methods` trains, resumes, saves and bakes them, as the configuration `gaussian_avatars-features`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from known import known
from mien import runtime
from mien.avatar import GaussianAvatarsConfig, load_avatar
from mien.avatar.baking import make_portable
from mien.avatar.files import write_avatar
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.gaussian_avatars.changes import mean_squares
from mien.avatar.ops.expression_changes import (
    MARGIN,
    activations_reference,
    outermost,
    principal_directions,
    within_seen,
)
from mien.avatar.ops.feature_network import Layers, network_outputs
from mien.avatar.settings import Progress, Rate
from mien.formats.shared.packed import pack
from mien.gaussians import Gaussians
from mien.runtime.checks import baked_fault
from mono_avatars import pictured
from plain_settings import plain_gaussian_avatars
from refusals import refuses
from toy_scene import random, runtime_face, toy_camera, toy_face, toy_face_model

BASES = ("color_basis", "opacity_basis", "offset_basis")
PARTS = ("means", "quats", "scales", "opacities", "sh")


def new_avatar(rank: int = 2, filled: bool = True, **settings: object) -> GaussianAvatars:
    """Return an avatar whose bases are random, as after training, or zero."""
    torch.manual_seed(0)
    config = replace(plain_gaussian_avatars(expression_rank=rank), **settings)  # pyright: ignore[reportArgumentType]
    avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
    for index, name in enumerate(BASES):
        if filled and name in avatar.store.names():
            avatar.store.assign(name, 0.3 * random(*avatar.store[name].shape, seed=index))
    return avatar


def test_activations_follow_training_within_its_range_and_stop_soon_after() -> None:
    margin = 2.0 * MARGIN
    along = torch.tensor([0.6, 0.8])
    seen = torch.stack([2 * along, torch.tensor([-3.0, 0.0])])
    lengths = torch.tensor([0.0, 1.0, 2.0, 2.0 + margin, 1e6])
    expected = torch.tensor([0.0, 1.0, 2.0, 2.0 + margin / 2, 2.0 + margin])
    shortened = within_seen(lengths[:, None] * along, seen)
    torch.testing.assert_close(shortened, expected[:, None] * along, rtol=0, atol=1e-5)
    # Of (0.8, -0.6), training saw nothing: the product with its rows is 0 and less.
    assert within_seen(torch.tensor([[0.8, -0.6], [8.0, -6.0]]), seen).abs().max() < 1e-5
    assert torch.equal(within_seen(lengths[:, None] * along, seen[:0]), lengths[:, None] * along)
    inputs = torch.cat([lengths[1:4, None] * along, torch.tensor([[-4.0, 0.5], [2.0, 3.0]])]).double() + 0.01
    assert torch.autograd.gradcheck(lambda x: within_seen(x, seen.double()), inputs.requires_grad_())
    activations = random(200, 4)
    seen = outermost(activations)
    assert len(seen) < 100
    assert torch.equal(within_seen(activations, seen), activations)


def test_native_activations_equal_their_reference() -> None:
    avatar, face = new_avatar(), toy_face(5)
    fixed = [getattr(avatar.activations, name).double() for name in ("rest", "directions", "seen")]
    face = replace(face, expression=(3 * face.expression).requires_grad_())
    ours = avatar.activations(face)
    theirs = activations_reference(torch.cat([face.expression, face.joints.flatten(1)], -1).double(), *fixed)
    torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-5)
    by_ours, by_theirs = (torch.autograd.grad(a[..., 0].sum(), face.expression)[0] for a in (ours, theirs))
    torch.testing.assert_close(by_ours, by_theirs, rtol=1e-4, atol=1e-5)
    assert bool(by_ours.abs().sum() > 0)


def test_directions_are_those_of_the_largest_spread() -> None:
    axes = torch.linalg.qr(random(6, 6)).Q
    offsets = (random(500, 6, seed=1) * torch.tensor([4.0, 2.0, 0, 0, 0, 0])) @ axes.T
    directions = principal_directions(offsets, 4)
    along = offsets @ directions
    assert (directions[:, 0] @ axes[:, 0]).abs() * 4 == pytest.approx(1, abs=0.1)
    torch.testing.assert_close(along.std(0)[:2], torch.ones(2), rtol=0, atol=0.02)
    # There are only two directions in these timesteps; the others do nothing.
    assert directions[:, 2:].abs().max() == 0


def unequal(one: Gaussians, other: Gaussians) -> list[str]:
    pairs = {name: torch.broadcast_tensors(getattr(one, name), getattr(other, name)) for name in PARTS}
    return [name for name, pair in pairs.items() if not torch.equal(*pair)]


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_bases_start_at_zero_and_move_what_they_are_named_after(sh_degree: int) -> None:
    face = toy_face(5)
    start = new_avatar(2, filled=False, sh_degree=sh_degree).pose(face).gaussians
    assert unequal(new_avatar(0, sh_degree=sh_degree).pose(face).gaussians, start) == []
    for basis, moved in zip(BASES, ("sh", "opacities", "means"), strict=True):
        avatar = new_avatar(2, filled=False, sh_degree=sh_degree)
        avatar.store.assign(basis, torch.ones(()))
        assert unequal(start, avatar.pose(face).gaussians) == [moved], basis


def test_children_inherit_the_bases_and_faint_ones_are_judged_at_their_best() -> None:
    avatar, parents = new_avatar(), torch.tensor([3, 3])
    avatar.store.append(parents, avatar.density().split(avatar.store, parents, random(2, 3)))
    assert all(torch.equal(avatar.store[name][-2:], avatar.store[name][parents]) for name in BASES)
    seen = torch.full((len(avatar.store),), 0.7)
    assert avatar.density().judged_opacities is None, "by the highest opacity of each"
    fixed = new_avatar(expression_changes=("color", "offset"))
    judged = fixed.density().judged_opacities
    assert judged is not None
    assert not torch.equal(judged(fixed.store, seen[:-2]), seen[:-2])


def test_the_prior_is_the_mean_square_of_the_changes() -> None:
    avatar = new_avatar(expression_weight=2.0)
    posed = avatar.pose(toy_face(5)[1])
    loss = avatar.regularizers(posed, pictured(len(avatar.store)), Progress(0, 1))["expression"].item()
    expected = 2 * sum(posed.aux[name].detach().square().mean().item() for name in BASES)
    assert loss == pytest.approx(expected, rel=1e-5)
    assert loss > 0.01
    tensors = [random(*shape).double().requires_grad_() for shape in ((7, 3), (7,))]
    assert torch.autograd.gradcheck(lambda *own: mean_squares(0.3, *own), tensors)


def test_avatars_on_disk_keep_what_training_saw(tmp_path: Path) -> None:
    avatar = new_avatar(2)
    avatar.activations.seen = random(7, 2)
    write_avatar(tmp_path, avatar)
    loaded = load_avatar(tmp_path)
    assert isinstance(loaded, GaussianAvatars)
    assert torch.equal(loaded.activations.seen, avatar.activations.seen)


@pytest.mark.unchecked
def test_impossible_changes_are_refused() -> None:
    baked = new_avatar(2).bake()
    changes = known(baked.changes)
    parts = {name: getattr(changes, name) for name in ("color", "opacity_logits", "means", "directions", "seen")}
    for wrong, part in (
        ({name: parts[name][:3] for name in ("color", "opacity_logits", "means")}, "changes.color has the shape"),
        ({"rest": changes.rest[:1], "directions": changes.directions[:1]}, "changes.rest has the shape"),
        ({"seen": changes.seen[:, :1]}, "changes.seen has the shape"),
        ({name: array[..., :0] for name, array in parts.items()}, "0 activations"),
        ({"directions": changes.directions * np.float32("nan")}, "NaN"),
    ):
        assert part in known(baked_fault(replace(baked, changes=replace(changes, **wrong))))


RANK, DIRECTIONS = 3, 5
CONFIG = plain_gaussian_avatars(
    expression_rank=RANK, expression_changes=("opacity", "offset"), appearance="features",
    appearance_directions=DIRECTIONS, appearance_features=6,
)  # fmt: skip


def with_features(config: GaussianAvatarsConfig = CONFIG, *, filled: bool = True) -> GaussianAvatars:
    """Return an avatar whose features and network are random, as after training, or as before it."""
    torch.manual_seed(0)
    avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
    if filled:
        torch.manual_seed(1)
        for name in set(avatar.store.names()) & {"feature_bases", "neutral_features", "offset_basis", "opacity_basis"}:
            avatar.store.assign(name, 0.3 * torch.randn(avatar.store[name].shape))
        with torch.no_grad():
            known(avatar.appearance).last.weight.normal_(0, 0.3)
    return avatar


def test_an_avatar_starts_as_without_features_and_changes_with_them_have_a_penalty() -> None:
    plain = plain_gaussian_avatars(expression_rank=RANK, expression_changes=("opacity", "offset"))
    torch.manual_seed(0)
    static = GaussianAvatars(plain, toy_face_model(), toy_face(5))
    ours, theirs = (avatar.pose(toy_face(5)).gaussians for avatar in (with_features(filled=False), static))
    assert all(torch.equal(getattr(ours, part), getattr(theirs, part)) for part in PARTS)
    avatar = with_features(CONFIG)
    for name in ("feature_bases", "neutral_features"):
        avatar.store[name].data[0] = 0
    posed = avatar.pose(toy_face(5)[1])
    changes = [posed.aux[name] for name in ("feature_color", "feature_opacity")]
    assert all(not each[0].any() and each[1].any() for each in changes)
    losses = avatar.regularizers(posed, pictured(len(avatar.store)), Progress(0, 1))
    torch.testing.assert_close(losses["appearance"], 0.1 * sum(each.square().mean() for each in changes))


def test_color_and_opacity_change_by_the_network() -> None:
    avatar, face = with_features(), toy_face(5)[2]
    store, (activations,) = avatar.store, avatar.activations(face)
    exact = Layers(*(tensor.double() for tensor in known(avatar.appearance).layers()))
    bases, neutral = store["feature_bases"].double(), store["neutral_features"].double()
    blended = neutral + torch.einsum("nkf,k->nf", bases, activations.double())
    color, opacity = network_outputs(blended, neutral.new_zeros(len(neutral), 0), exact)
    static = GaussianAvatars(replace(CONFIG, appearance="static"), toy_face_model(), toy_face(5))
    static.store.load_state_dict({name: store.state_dict()[name] for name in static.store.state_dict()})
    posed, plain = avatar.pose(face).gaussians, static.pose(face).gaussians
    logits = store["opacity_logits"] + opacity + store["opacity_basis"] @ activations[:RANK]
    torch.testing.assert_close(posed.sh.view(-1, 3).double(), store["sh_constant"][:, 0] + color, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(posed.opacities.view(-1).double(), logits.sigmoid(), atol=1e-6, rtol=1e-5)
    assert color.abs().max() > 0.1
    assert all(torch.equal(getattr(posed, part), getattr(plain, part)) for part in ("means", "quats", "scales"))


@pytest.mark.parametrize("settings", [{}, {"expression_changes": ("color",)}])
def test_baked_avatars_pose_alike_far_from_what_was_filmed(settings: dict[str, Rate], tmp_path: Path) -> None:
    avatar, face = with_features(replace(CONFIG, **settings)), toy_face(5)
    face, portable = replace(face, expression=30.0 * face.expression), make_portable(avatar, toy_camera(64), "toy")
    runtime.write_portable(tmp_path / "a.mien", portable)
    baked, expected = runtime.load(tmp_path / "a.mien").portable.baked, avatar.pose(face).gaussians
    for index in range(len(face)):
        found, truth = runtime.pose(baked, runtime_face(face[index])), expected.timestep(index)
        for part in PARTS:
            own, theirs = getattr(found, part), getattr(truth, part).detach().numpy()
            np.testing.assert_allclose(own, theirs, atol=1e-5, rtol=1e-4, err_msg=part)
    assert pack(portable), "a page holds them"


def test_features_have_their_own_number_of_activations() -> None:
    avatar = with_features()
    assert avatar.store["feature_bases"].shape[1] == DIRECTIONS
    assert avatar.store["offset_basis"].shape[-1] == RANK
    baked = avatar.bake()
    changes = known(baked.changes)
    features = known(changes.features)
    assert changes.basis_columns == RANK
    rows = {name: getattr(features, name)[:-1] for name in ("neutral", "basis", "own")}
    for change, part in (
        *(({"basis_columns": columns}, "") for columns in (0, RANK + 1, 99)),
        ({"features": replace(features, **rows)}, "features"),
        ({"features": replace(features, basis=features.basis[:, :-1])}, "features"),
        (
            {"features": replace(features, biases=(features.biases[0], features.biases[1][:3]))},
            "layers of its features",
        ),
    ):
        assert part in known(baked_fault(replace(baked, changes=replace(changes, **change))))
    alone = replace(CONFIG, expression_rank=0)
    alone.check()
    assert baked_fault(with_features(alone).bake()) is None
    few = replace(GaussianAvatarsConfig(), appearance_directions=3, expression_rank=4)
    refuses(r"--method.appearance-directions 3: .* --method.expression-rank 4", few.check)
    replace(few, appearance_directions=4).check()
