"""Changes of gaussian_avatars with the expression: their formulas, and what of them is kept and refused.

`test_methods` trains, resumes, saves and bakes them, as the configuration `gaussian_avatars-features`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from mien import _native, runtime
from mien.avatar import GaussianAvatars, Progress, Rate, load_avatar, make_portable, write_avatar
from mien.avatar.gaussian_avatars.avatar import resting_opacities
from mien.avatar.gaussian_avatars.changes import mean_squares
from mien.avatar.ops.expression_changes import (
    MARGIN,
    activations_reference,
    expression_change,
    expression_change_reference,
    outermost,
    principal_directions,
    within_seen,
)
from mien.errors import UserError
from mien.render.rendering import Rendering
from plain_settings import plain_gaussian_avatars
from toy_scene import toy_camera, toy_face, toy_face_model

BASES = ("color_basis", "opacity_basis", "offset_basis")
PARTS = ("means", "quats", "scales", "opacities", "sh")


def random(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def new_avatar(rank: int = 2, filled: bool = True, **settings: object) -> GaussianAvatars:
    """Return an avatar whose bases are random, as after training, or zero."""
    torch.manual_seed(0)
    config = replace(plain_gaussian_avatars(expression_rank=rank), **settings)  # pyright: ignore[reportArgumentType]
    avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
    for index, name in enumerate(BASES):
        if filled and name in avatar.store.names():
            avatar.store.assign(name, 0.3 * random(*avatar.store[name].shape, seed=index))
    return avatar


@pytest.mark.parametrize("rank", range(1, 9))
def test_native_changes_equal_their_reference(isa: str, rank: int) -> None:
    for shape in ((0,), (1,), (17, 3), (9000, 3)):
        check_native_changes(rank, shape)


def check_native_changes(rank: int, shape: tuple[int, ...]) -> None:
    results = []
    for function, dtype in ((expression_change, torch.float32), (expression_change_reference, torch.float64)):
        basis, activations = (t.to(dtype).requires_grad_() for t in (random(*shape, rank), random(rank, seed=1)))
        change = function(basis, activations)
        gradients = torch.autograd.grad(change, [basis, activations], random(*shape, seed=2).to(dtype))
        results.append([tensor.double() for tensor in (change, *gradients)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_changes_have_the_same_bits_for_any_number_of_threads() -> None:
    before, results = _native.thread_count(), []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        basis, activations = random(20_000, 3, 8).requires_grad_(), random(8, seed=1).requires_grad_()
        change = expression_change(basis, activations)
        results.append((change, *torch.autograd.grad(change.square().sum(), [basis, activations])))
    _native.set_thread_count(before)
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))


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


def test_frames_of_training_are_not_shortened() -> None:
    activations = random(200, 4)
    seen = outermost(activations)
    assert len(seen) < 100
    assert torch.equal(within_seen(activations, seen), activations)
    # One expression alone is held long before it has the length of what many together have.
    alone = torch.tensor([[1.2 * float(activations[:, 0].max()), 0, 0, 0]])
    assert float(alone.norm()) < float(activations.norm(dim=1).max())
    assert float(within_seen(alone, seen).norm()) < float(alone.norm())


def test_native_activations_equal_their_reference() -> None:
    avatar = new_avatar()
    fixed = [getattr(avatar.activations, name) for name in ("rest", "directions", "seen")]
    face = toy_face(5)
    face = replace(face, expression=(3 * face.expression).requires_grad_())
    inputs = torch.cat([face.expression, face.joints.flatten(1)], -1)
    ours = avatar.activations(face)
    theirs = activations_reference(inputs.double(), *(tensor.double() for tensor in fixed))
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


def test_rank_0_is_the_method_without_changes() -> None:
    still = {f"expression_{name}_rate": Rate(0.0) for name in ("color", "opacity", "offset")}
    for avatar in (new_avatar(0), new_avatar(4, True, **still)):
        assert not [name for name in avatar.state_dict() if "basis" in name or "activations" in name]
        assert avatar.pose(toy_face(5)).aux == {}
        assert avatar.bake().changes is None
        assert avatar.density().judged_opacities is resting_opacities


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_bases_start_at_zero_and_move_what_they_are_named_after(sh_degree: int) -> None:
    face = toy_face(5)
    plain = new_avatar(0, sh_degree=sh_degree).pose(face).gaussians
    start = new_avatar(2, filled=False, sh_degree=sh_degree).pose(face).gaussians
    for name in PARTS:
        assert torch.equal(getattr(plain, name).expand_as(getattr(start, name)), getattr(start, name)), name
    for basis, moved in zip(BASES, ("sh", "opacities", "means"), strict=True):
        avatar = new_avatar(2, filled=False, sh_degree=sh_degree)
        avatar.store.assign(basis, torch.ones(()))
        changed = avatar.pose(face).gaussians
        for name in PARTS:
            assert torch.equal(getattr(start, name), getattr(changed, name)) == (name != moved), (basis, name)


def test_timesteps_together_are_those_one_by_one() -> None:
    avatar, face = new_avatar(), toy_face(5)
    together = avatar.pose(face)
    for timestep in range(5):
        alone = avatar.pose(face[timestep])
        for name in (*PARTS, "T_world_local"):
            one, other = (getattr(p.gaussians.timestep(i), name) for p, i in ((together, timestep), (alone, 0)))
            assert torch.equal(one, other), name
        assert all(torch.equal(together.aux[name][timestep], alone.aux[name]) for name in BASES)


def test_children_inherit_the_bases_and_faint_ones_are_judged_at_their_best() -> None:
    avatar = new_avatar()
    parents = torch.tensor([3, 3])
    overrides = avatar.density().split(avatar.store, parents, random(2, 3))
    avatar.store.append(parents, overrides)
    for name in BASES:
        assert torch.equal(avatar.store[name][-2:], avatar.store[name][[3, 3]])
    seen = torch.full((len(avatar.store),), 0.7)
    assert torch.equal(avatar.density().judged_opacities(avatar.store, seen), seen)
    fixed = new_avatar(expression_opacity_rate=Rate(0.0))
    assert not torch.equal(fixed.density().judged_opacities(fixed.store, seen[:-2]), seen[:-2])


def test_the_prior_is_the_mean_square_of_the_changes() -> None:
    avatar = new_avatar(expression_weight=2.0)
    posed = avatar.pose(toy_face(5)[1])
    radii = torch.ones(len(avatar.store), dtype=torch.int32)
    rendering = Rendering(torch.zeros(4, 4, 3), torch.zeros(4, 4), radii, torch.zeros(len(radii), 2))
    losses = avatar.regularizers(posed, rendering, Progress(0, 1))
    expected = 2 * sum(posed.aux[name].detach().square().mean().item() for name in BASES)
    assert losses["expression"].item() == pytest.approx(expected, rel=1e-5)
    assert losses["expression"].item() > 0.01


def test_avatars_on_disk_keep_what_training_saw(tmp_path: Path) -> None:
    avatar = new_avatar(2)
    avatar.activations.seen = random(7, 2)
    write_avatar(tmp_path, avatar)
    loaded = load_avatar(tmp_path)
    assert isinstance(loaded, GaussianAvatars)
    assert torch.equal(loaded.activations.seen, avatar.activations.seen)
    avatar.activations.seen = random(7, 3)
    write_avatar(tmp_path, avatar)
    with pytest.raises(UserError, match="does not fit its settings"):
        load_avatar(tmp_path)


def test_impossible_changes_are_refused(tmp_path: Path) -> None:
    whole = make_portable(new_avatar(2), toy_camera(32), "toy")
    baked = whole.baked
    assert isinstance(baked, runtime.MeshBound)
    changes = baked.changes
    assert changes is not None
    parts = {name: getattr(changes, name) for name in ("color", "opacity_logits", "means")}
    fixed = {name: getattr(changes, name) for name in ("rest", "directions", "seen")}
    none = {name: array[..., :0] for name, array in (parts | fixed).items() if name != "rest"}
    for wrong, part in (
        (replace(changes, **{name: array[:3] for name, array in parts.items()}), "the shape of color of its changes"),
        (replace(changes, rest=fixed["rest"][:1], directions=fixed["directions"][:1]), "the shape of rest of its"),
        (replace(changes, seen=changes.seen[:, :1]), "the shape of seen of its"),
        (replace(changes, **none), "0 activations"),
        (replace(changes, directions=changes.directions * np.float32("nan")), "NaN"),
    ):
        with pytest.raises(UserError, match=part):
            runtime.write_portable(tmp_path / "a.mien", replace(whole, baked=replace(baked, changes=wrong)))


def test_mean_squares_are_what_autograd_computes() -> None:
    tensors = [torch.randn(7, 3, dtype=torch.float64, requires_grad=True), torch.randn(7, dtype=torch.float64)]
    tensors[1].requires_grad_()
    assert torch.autograd.gradcheck(lambda *own: mean_squares(0.3, *own), tensors)
    expected = 0.3 * sum(own.square().mean() for own in tensors)
    torch.testing.assert_close(mean_squares(0.3, *tensors), expected)
