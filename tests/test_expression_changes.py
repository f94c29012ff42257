"""Changes of gaussian_avatars with the expression: their formulas, and what of them is kept and refused.
`test_methods` trains, resumes, saves and bakes them, as the configuration `gaussian_avatars-features`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from known import known
from mien import _native, runtime
from mien.avatar import GaussianAvatarsConfig
from mien.avatar.baking import make_portable
from mien.avatar.gaussian_avatars.avatar import GaussianAvatars
from mien.avatar.ops import expression_changes as ops
from mien.avatar.ops.feature_network import Layers, network_outputs
from mien.avatar.ops.regions import region_shares, vertex_motions
from mien.avatar.settings import Progress
from mien.face import FaceModel, FaceParams, load_face_model
from mien.formats.shared.packed import unpacked
from mien.gaussians import Gaussians
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.checks import baked_fault
from mono_avatars import pictured
from plain_settings import plain_gaussian_avatars
from refusals import refuses
from toy_scene import random, runtime_face, toy_camera, toy_face, toy_face_model

BASES = ("color_basis", "opacity_basis", "offset_basis")
PARTS = ("means", "quats", "scales", "opacities", "sh")
RANK, DIRECTIONS = 3, 5
KINDS: dict[str, Any] = {"expression_changes": ("opacity", "offset")}
FEATURES = KINDS | {"appearance": "features", "appearance_directions": DIRECTIONS, "appearance_features": 6}
Person = tuple[FaceModel, FaceParams]


@pytest.fixture(scope="module")
def person() -> Person:
    """A face model with regions, and a person at rest who then grimaces at random."""
    model = load_face_model("anny")
    rest = model.neutral(30)
    random_face = {"expression": random(*rest.expression.shape).sigmoid(), "joints": 0.2 * random(30, 3, 3, seed=1)}
    turned = {"head_rotation": 0.2 * random(30, 3, seed=2), "head_translation": 0.03 * random(30, 3, seed=3)}
    return model, replace(rest, **random_face, **turned)


def new_avatar(rank: int = 2, filled: bool = True, person: Person | None = None, **settings: Any) -> GaussianAvatars:
    """Return an avatar whose bases, features and network are random, as after training, or as before it."""
    torch.manual_seed(0)
    avatar = GaussianAvatars(
        plain_gaussian_avatars(expression_rank=rank, **settings), *(person or (toy_face_model(), toy_face(5)))
    )
    for index, name in enumerate((*BASES, "feature_bases", "neutral_features")):
        if filled and name in avatar.store.names():
            avatar.store.assign(name, 0.3 * random(*avatar.store[name].shape, seed=index))
    if filled and avatar.appearance is not None:
        torch.nn.init.normal_(avatar.appearance.last.weight, 0, 0.3)
    return avatar


def test_activations_follow_training_within_its_range_and_stop_soon_after() -> None:
    margin = 2.0 * ops.MARGIN
    along = torch.tensor([0.6, 0.8])
    seen = torch.stack([2 * along, torch.tensor([-3.0, 0.0])])
    lengths = torch.tensor([0.0, 1.0, 2.0, 2.0 + margin, 1e6])
    expected = torch.tensor([0.0, 1.0, 2.0, 2.0 + margin / 2, 2.0 + margin])
    shortened = ops.within_seen(lengths[:, None] * along, seen)
    torch.testing.assert_close(shortened, expected[:, None] * along, rtol=0, atol=1e-5)
    # Of (0.8, -0.6), training saw nothing: the product with its rows is 0 and less.
    assert ops.within_seen(torch.tensor([[0.8, -0.6], [8.0, -6.0]]), seen).abs().max() < 1e-5
    assert torch.equal(ops.within_seen(lengths[:, None] * along, seen[:0]), lengths[:, None] * along)
    activations = random(200, 4)
    seen = ops.outermost(activations)
    assert len(seen) < 100
    assert torch.equal(ops.within_seen(activations, seen), activations)


def test_directions_are_those_of_the_largest_spread() -> None:
    axes = torch.linalg.qr(random(6, 6)).Q
    offsets = (random(500, 6, seed=1) * torch.tensor([4.0, 2.0, 0, 0, 0, 0])) @ axes.T
    directions = ops.principal_directions(offsets, 4)
    along = offsets @ directions
    assert (directions[:, 0] @ axes[:, 0]).abs() * 4 == pytest.approx(1, abs=0.1)
    torch.testing.assert_close(along.std(0)[:2], torch.ones(2), rtol=0, atol=0.02)
    # There are only two directions in these timesteps; the others do nothing.
    assert directions[:, 2:].abs().max() == 0


def test_regions_share_the_head_smoothly(person: Person) -> None:
    model, rest = person[0], person[0].neutral()
    shares, vertices = region_shares(model, rest), model.head_vertices(rest)[0]
    torch.testing.assert_close(shares.sum(1), torch.ones(len(vertices)))
    assert shares.min() >= 0
    first, second = torch.cat([model.faces[:, [0, 1]], model.faces[:, [1, 2]]]).T
    lengths = (vertices[first] - vertices[second]).norm(dim=1)
    gaps = (shares[first] - shares[second])[shares[first, 5] == shares[second, 5]].abs().amax(1)
    assert (gaps < 200 * lengths[shares[first, 5] == shares[second, 5]]).all(), "none but the inside ends within 5 mm"
    teeth = model.faces[model.region_mask("teeth")].long()
    assert shares[teeth][..., 5].min() == 1, "teeth change with what moves the inside of the mouth"
    # The inner brows and the eyes, left and right, and the mouth.
    for region, (begin, end) in enumerate(((22, 24), (20, 22), (42, 48), (36, 42), (48, 68))):
        assert model.landmark_positions(shares[:, [region] * 3], "ibug68")[begin:end].min() > 0.8
    assert shares[vertices[:, 1].argmax(), -1] == 1, "what is around the face"
    assert region_shares(toy_face_model(), toy_face(1)).eq(1).all(), "a model without landmarks is one region"


def test_brows_and_mouth_change_with_their_own_expressions_and_all_with_the_head(person: Person) -> None:
    """Gaussians that an expression does not move keep the bytes of activations, colours, opacities and offsets."""
    avatar = new_avatar(RANK, person=person, **FEATURES)
    model, rest, face = person[0], avatar.subject, person[1][3]
    shares, inputs = region_shares(model, rest), torch.eye(len(model.expression_names))
    groups = [2, 3, 4, 5, 6], [0, 1, 2, 3, 5, 6], [0, 1, 2, 3, 4, 5]
    sides = [(shares[model.faces][..., others] == 0).all((1, 2)) for others in groups]
    motions = vertex_motions(model, rest).norm(dim=2) @ shares
    neck = len(model.expression_names) + 3 * model.free_joint_names.index("neck")
    assert not motions[neck : neck + 3].any()

    def changes(face: FaceParams) -> list[list[Tensor]]:
        """Return the changes of brows, of the mouth, and of what is around the face."""
        parts = [avatar.activations(face), *(own for own in avatar.pose(face).aux.values() if own.ndim)]
        return [[part[side] for part in parts] for side in sides]

    before = changes(face)
    assert len(before[0]) == 5
    for name, own, most in (
        ("mouthLowerDownLeft", 1, 0.0), ("jawOpen", 1, 0.03), ("browInnerUp", 0, 0.03)
    ):  # fmt: skip
        index = model.expression_names.index(name)
        strengths = motions[index, :2].max(), motions[index, 4]
        assert strengths[1 - own] <= most * strengths[own]
        after = changes(replace(face, expression=face.expression + inputs[index]))
        assert not any(map(torch.equal, before[own], after[own]))
        assert most or all(map(torch.equal, before[1 - own], after[1 - own]))
        assert not any(map(torch.equal, before[2], after[2])), "around the face, all expressions count"
        moved = [(after[side][0] - before[side][0]).abs().max() for side in (0, 1)]
        assert moved[1 - own] <= most * moved[own]
    after = changes(replace(face, head_rotation=face.head_rotation + 0.2))
    assert not any(torch.equal(*pair) for side in (0, 1) for pair in zip(after[side], before[side], strict=True))
    turned = [after[side][0] - before[side][0] for side in (0, 1)]
    torch.testing.assert_close(turned[0], turned[1][:1].expand_as(turned[0]))
    assert turned[0].any(0).tolist() == [False, True, False, True, False]


@pytest.mark.parametrize("count", [1, 2, 7])
def test_native_activations_equal_their_reference(person: Person, count: int) -> None:
    for model, face in (person, (toy_face_model(), toy_face(5))):
        activations = ops.ExpressionActivations(model, face, face[1], count)
        far = replace(face, expression=(3 * face.expression).requires_grad_())
        found = torch.stack([activations(one) for one in (face[3], far[4], far[0])])
        assert found.shape == (3, len(model.faces), count)
        assert not found.requires_grad
        exact, far = activations.double(), far.to(torch.zeros((), dtype=torch.float64))
        expected = torch.stack([exact.reference(one) for one in (face[3].to(far.expression), far[4], far[0])])
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5)
        assert expected.abs().max() > 0.1


def test_a_heads_motion_is_a_turn_and_a_shift_along_its_own_axes_however_the_world_turns() -> None:
    turns, shifts, at_rest, place = 0.5 * random(20, 3), random(20, 3, seed=1), random(3, seed=2), random(3, seed=3)
    turns[0] = 0
    expected = torch.cat([torch.sinc(turns.norm(dim=1, keepdim=True) / torch.pi) * turns, shifts], 1)
    R = matrix_from_axis_angle(at_rest)
    for world in (torch.zeros(3), random(3, seed=4)):
        W = matrix_from_axis_angle(world)
        rest = torch.cat([axis_angle_from_matrix(W @ R), W @ place + world])
        rotations = axis_angle_from_matrix(W @ R @ matrix_from_axis_angle(turns))
        poses = torch.cat([rotations, (place + shifts @ R.T) @ W.T + world], 1)
        along = _native.make_face_activations(
            torch.zeros(1), torch.zeros(1, 6), torch.zeros(0, 6), None, rest, torch.eye(6), torch.zeros(0, 6)
        )
        native = torch.full((20, 12), torch.nan)
        for pose, out in zip(poses, native, strict=True):
            _native.activation_table(along, torch.zeros(1), torch.zeros(0), pose[:3], pose[3:], out[None])
        native = native[:, 1::2]  # those of the face and of the head take turns
        faces = [replace(toy_face(len(own)), head_rotation=own[:, :3], head_translation=own[:, 3:])
                 for own in (rest[None], poses)]  # fmt: skip
        for found in (native, ops.head_motion(*faces)):
            torch.testing.assert_close(found, expected, rtol=0, atol=3e-6)


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


def test_an_avatar_starts_as_without_features_and_changes_with_them_have_a_penalty() -> None:
    static, start = (new_avatar(RANK, filled=False, **given).pose(toy_face(5)).gaussians for given in (KINDS, FEATURES))
    assert unequal(start, static) == []
    avatar = new_avatar(RANK, **FEATURES)
    for name in ("feature_bases", "neutral_features"):
        avatar.store[name].data[0] = 0
    posed = avatar.pose(toy_face(5)[1])
    changes = [posed.aux[name] for name in ("feature_color", "feature_opacity")]
    assert all(not each[0].any() and each[1].any() for each in changes)
    losses = avatar.regularizers(posed, pictured(len(avatar.store)), Progress(0, 1))
    torch.testing.assert_close(losses["appearance"], 0.1 * sum(each.square().mean() for each in changes))


def test_color_and_opacity_change_by_the_network(person: Person) -> None:
    avatar, face = new_avatar(RANK, person=person, **FEATURES), person[1][2]
    store, activations = avatar.store, avatar.activations(face)[avatar.store["face_index"]]
    exact = Layers(*(tensor.double() for tensor in known(avatar.appearance).layers()))
    bases, neutral = store["feature_bases"].double(), store["neutral_features"].double()
    blended = neutral + torch.einsum("nkf,nk->nf", bases, activations.double())
    color, opacity = network_outputs(blended, neutral.new_zeros(len(neutral), 0), exact)
    posed = avatar.pose(face).gaussians
    logits = store["opacity_logits"] + opacity + (store["opacity_basis"] * activations[:, :RANK]).sum(1)
    torch.testing.assert_close(posed.sh.view(-1, 3).double(), store["sh_constant"][:, 0] + color, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(posed.opacities.view(-1).double(), logits.sigmoid(), atol=1e-6, rtol=1e-5)
    assert color.abs().max() > 0.1


@pytest.mark.parametrize("settings", [{}, {"expression_changes": ("color",)}])
def test_baked_avatars_pose_alike_far_from_what_was_filmed(person: Person, settings: Any, tmp_path: Path) -> None:
    avatar, face = new_avatar(RANK, person=person, **FEATURES | settings), person[1]
    portable, face = make_portable(avatar, toy_camera(64), "toy"), replace(face, expression=30 * face.expression)[:3]
    runtime.write_portable(tmp_path / "a.mien", portable)
    baked, expected = runtime.load(tmp_path / "a.mien").portable.baked, avatar.pose(face).gaussians
    for index in range(len(face)):
        found, truth = runtime.pose(baked, runtime_face(face[index])), expected.timestep(index)
        for part in PARTS:
            own, theirs = getattr(found, part), getattr(truth, part).detach().numpy()
            np.testing.assert_allclose(own, theirs, atol=1e-5, rtol=1e-4, err_msg=part)
    packed, shares = unpacked(portable).baked, known(known(avatar.bake().changes).shares)
    assert isinstance(packed, runtime.MeshBound)
    coded = known(known(packed.changes).shares)
    np.testing.assert_allclose(coded, shares, atol=0.004)
    assert not coded[shares == 0].any()


@pytest.mark.unchecked
def test_impossible_changes_are_refused() -> None:
    baked = new_avatar(RANK, **FEATURES).bake()
    changes = known(baked.changes)
    features, head, shares = known(changes.features), known(changes.head), known(changes.shares)
    means = known(changes.means)
    assert (features.basis.shape[1], means.shape[2], changes.basis_columns) == (DIRECTIONS, RANK, RANK)
    rows = {name: getattr(features, name)[:-1] for name in ("neutral", "basis", "own")}
    biases = (features.biases[0], features.biases[1][:3])
    for wrong, part in (
        ({"means": means[:3]}, "means has the shape"), ({"rest": changes.rest[:1]}, "rest has the shape"),
        ({"directions": changes.directions[:1]}, "directions has the shape"),
        ({"directions": changes.directions * np.float32("nan")}, "NaN"),
        ({"directions": changes.directions[:, :0]}, "0 activations of 1 regions"),
        ({"seen": changes.seen[:, :1]}, "seen has the shape"), ({"shares": shares[1:]}, "shares has the shape"),
        ({"shares": shares[:, [0, 0]]}, "3 activations of 2 regions"),
        ({"shares": shares[:, :0]}, "3 activations of 0 regions"), ({"head": None}, "features.basis has the shape"),
        *(({"head": replace(head, **{name: value})}, f"head.{name} has the shape") for name, value in (
            ("rest", head.rest[:5]), ("directions", head.directions[:5]), ("seen", head.seen[:, :1]))),
        *(({"basis_columns": columns}, f"take {columns} of 5 activations") for columns in (0, 6, 99)),
        ({"basis_columns": RANK + 1}, "has the shape"), ({"features": replace(features, **rows)}, "features"),
        ({"features": replace(features, basis=features.basis[:, :-1])}, "features"),
        ({"features": replace(features, biases=biases)}, "layers of its features"),
    ):  # fmt: skip
        assert part in known(baked_fault(replace(baked, changes=replace(changes, **wrong)))), part
    avatar = new_avatar(0, **FEATURES)
    avatar.config.check()
    assert baked_fault(avatar.bake()) is None, "features have their own number of activations"
    few = replace(GaussianAvatarsConfig(), appearance_directions=3, expression_rank=4)
    refuses(r"--method.appearance-directions 3: .* --method.expression-rank 4", few.check)
    replace(few, appearance_directions=4).check()
