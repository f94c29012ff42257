"""MonoGaussianAvatar follows its formulas."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from known import known
from mien.avatar.mono_gaussian_avatar.avatar import MonoGaussianAvatar
from mien.avatar.mono_gaussian_avatar.motion import CANONICAL_JAW, canonical_face
from mien.avatar.mono_gaussian_avatar.networks import AttributeChangeNet, AttributeNet, Deformation, DeformationNet
from mien.avatar.mono_gaussian_avatar.schedule import Schedule, ScheduleName
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT, WeightNorm
from mien.avatar.ops.points import at_places, positional_encoding, random_places
from mien.avatar.settings import Progress, Rate
from mien.errors import UserError
from mien.face import FaceModel
from mien.face.mirror import triangle_geometry
from mien.face.posing import head_poses
from mien.runtime.checks import baked_fault
from mien.training import PRESETS
from mono_avatars import SMALL, new_avatar, pictured
from plain_settings import plain_mono_gaussian_avatar
from toy_scene import rgb_from_sh, toy_face, toy_face_model


def with_pose_correctives() -> FaceModel:
    face_model = toy_face_model()
    torch.manual_seed(3)
    return replace(face_model, pose_basis=0.01 * torch.randn(9, len(face_model.template), 3))


def canonical_places(avatar: MonoGaussianAvatar) -> Tensor:
    means = avatar.store["means"]
    return means + LENGTH_UNIT * avatar.deformation.whole(means / LENGTH_UNIT).offset


def test_canonical_jaw_is_open() -> None:
    follows, mean = toy_face_model(), toy_face(5).expression.mean(0)
    names, jaw = follows.joint_names, follows.joint_names.index("jaw")
    expression, joints = canonical_face(follows, mean)
    opening = follows.joint_rotation_basis[:, jaw, 0]
    assert float(expression @ opening) == pytest.approx(CANONICAL_JAW, abs=1e-6)
    # Only the coefficient that opens the jaw most has changed.
    assert (expression != mean).nonzero()[:, 0].tolist() == [int(opening.argmax())]
    assert joints.abs().max() == 0
    all_free, still = (True,) * len(names), torch.zeros_like(follows.joint_rotation_basis)
    expression, joints = canonical_face(replace(follows, joint_free=all_free, joint_rotation_basis=still), mean)
    assert torch.equal(expression, mean)
    turned = torch.zeros(len(names), 3)
    turned[jaw, 0] = CANONICAL_JAW
    torch.testing.assert_close(joints, turned)
    headless = replace(follows, joint_names=tuple("chin" if name == "jaw" else name for name in names))
    assert torch.equal(canonical_face(headless, mean)[0], mean)


def test_a_point_on_the_still_bone_stays_in_the_world_while_the_head_moves() -> None:
    avatar, face = new_avatar(), toy_face(5)
    bones, last = torch.eye(len(avatar.face_model.joint_names) + 1), avatar.deformation.skinning
    face = replace(face, head_rotation=torch.randn(5, 3), head_translation=torch.randn(5, 3))

    def in_world(bone: int) -> Tensor:
        with torch.no_grad():
            last.bias.copy_(10.0 * bones[bone])
        poses = head_poses(face)
        return torch.einsum("bij,bnj->bni", poses[:, :3, :3], avatar.pose(face).gaussians.means) + poses[:, None, :3, 3]

    with torch.no_grad():
        for weight in (last.weight, avatar.deformation.directions.weight, avatar.deformation.directions.bias):
            weight.zero_()
    still, moving = in_world(-1), in_world(0)  # and on the head's bone
    torch.testing.assert_close(still, still[:1].expand_as(still), atol=1e-5, rtol=0)
    assert (moving[0] - moving[1]).abs().max() > 0.1


class Perfect(DeformationNet):
    """Deformation network that knows the face model's vertices."""

    def __init__(self, face_model: FaceModel) -> None:
        torch.nn.Module.__init__(self)
        self.model = face_model

    def whole(self, points: Tensor) -> Deformation:
        expression, pose = (
            known(basis).permute(1, 2, 0) / LENGTH_UNIT
            for basis in (self.model.expression_basis, self.model.pose_basis)
        )
        weights = torch.nn.functional.pad(self.model.skinning_weights, (0, 1))
        return Deformation(torch.zeros_like(points), expression, pose, weights)

    def forward(self, points: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = self.whole(points)
        directions = torch.cat([found.expression, found.pose], dim=-1)
        return found.offset, torch.einsum("nxc,bc->bnx", directions, coefficients), found.weights


def test_vertices_with_their_own_directions_move_as_the_mesh_does_and_cost_nothing() -> None:
    avatar, face = new_avatar(face_model=with_pose_correctives()), toy_face(5)
    vertices = avatar.face_model.head_vertices(avatar.canonical_face())[0]
    avatar.store.resize(len(vertices))
    avatar.store.assign("means", vertices)
    avatar.deformation = Perfect(avatar.face_model)  # type: ignore[assignment]
    gaussians = avatar.pose(face).gaussians
    torch.testing.assert_close(gaussians.means, avatar.face_model.head_vertices(face), atol=1e-6, rtol=0)
    assert torch.equal(known(gaussians.T_world_local), head_poses(face))
    avatar.config = replace(SMALL, face_points=len(vertices))
    losses = avatar.regularizers(avatar.pose(face[1]), pictured(len(vertices)), Progress(0, 100))
    assert max(loss.item() for loss in losses.values()) < 1e-9


@pytest.mark.parametrize("units", ["each", "mean", "own"])
def test_losses_near_the_face_model_are_those_of_the_paper(units: str) -> None:
    """In units of the face model's own; those of the published code are `each`."""
    face_model, by_code = with_pose_correctives(), units == "each"
    names = ("face_expression_weight", "face_expression_units", "face_correctives_weight")
    supplement: dict[str, Any] = dict(zip(names, (1e3, units, 1e3), strict=True))
    for paper in (PRESETS["paper"].config(name) for name in ("mono_gaussian_avatar", "point_avatar")):
        assert {name: getattr(paper, name) for name in names} == {**supplement, "face_expression_units": "own"}
    avatar = new_avatar(replace(SMALL, face_points=12, **({} if by_code else supplement)), face_model)
    progress, rows = Progress(4, 100), torch.arange(18, 30)  # points 48 .. 59, in turn, of 30
    losses = avatar.regularizers(avatar.pose(toy_face(5)[1], progress), pictured(30), progress)
    found = avatar.deformation.whole(avatar.store["means"][rows] / LENGTH_UNIT)
    vertices = face_model.head_vertices(avatar.canonical_face())[0]
    nearest = (canonical_places(avatar)[rows, None] - vertices).norm(dim=-1).argmin(1)
    weights = found.weights - torch.nn.functional.pad(face_model.skinning_weights[nearest], (0, 1))
    torch.testing.assert_close(losses["skinning"], 10 * 0.1 * weights.square().mean())
    # Lengths are four times life size.
    pose = found.pose - 4 * known(face_model.pose_basis)[:, nearest].permute(1, 2, 0)
    expected = 10 * 10 * (10 * pose).square().mean() if by_code else 1000 * pose.square().mean()
    torch.testing.assert_close(losses["pose_correctives"], expected)
    # Coefficients and directions in units where the mean variance of coefficients is 1.
    variance = toy_face(5).expression.var(0, correction=0)
    unit = variance.mean()
    own = (found.expression - 4 * face_model.expression_basis[:, nearest].permute(1, 2, 0)).square()
    of_code = 10 * 10 * (100 * unit * own / (variance / unit * 2)).mean()
    expected = {"each": of_code, "mean": 1000 * unit * own.mean(), "own": 1000 * own.mean()}
    torch.testing.assert_close(losses["expression_directions"], expected[units])
    torch.stack(list(losses.values())).sum().backward()
    assert avatar.store["means"].grad is None, "the points do not feel these losses"


def test_joints_that_move_no_skin_are_no_bones() -> None:
    """They are in no mean and in no softmax. FLAME has nine of them here."""
    model, names = toy_face_model(), ("template", "identity_basis", "rotation_basis", "translation_basis")
    fields: Any = {f"joint_{name}": getattr(model, f"joint_{name}")[..., [0, 1, 0, 2], :] for name in names}
    fields |= {"joint_names": ("head", "neck", "idle", "jaw"), "joint_free": (False, True, False, False)}
    weights = model.skinning_weights[:, [0, 1, 0, 2]] * torch.tensor([1.0, 1, 0, 1])
    idle = replace(model, **fields, joint_parents=(-1, 0, 0, 0), skinning_weights=weights)
    avatars = [new_avatar(face_model=own) for own in (model, idle)]
    one, other = (avatar.face_losses(avatar.store["means"])["skinning"] for avatar in avatars)
    assert one == other
    for baked in (False, True):
        means = [avatar.train(not baked).pose(toy_face(5)[1]).gaussians.means for avatar in avatars]
        torch.testing.assert_close(*means, atol=1e-6, rtol=0)


def test_expressions_that_never_move_stay_finite() -> None:
    face = toy_face(5)
    for one in (
        *(replace(face, expression=face.expression * torch.tensor(way)) for way in ((1.0, 0), (0.0, 0))),
        face[0],
    ):
        avatar = MonoGaussianAvatar(SMALL, toy_face_model(), one)
        losses = avatar.regularizers(avatar.pose(one[0]), pictured(30), Progress(0, 10))
        assert all(loss.isfinite() for loss in losses.values())


def test_attributes_are_those_at_rest_and_their_change() -> None:
    avatar = new_avatar()
    got, means = avatar.pose(toy_face(5)[3], Progress(50, 100)).gaussians, avatar.store["means"]
    moved = (got.means[0] - canonical_places(avatar)) / LENGTH_UNIT
    raw = avatar.attributes(means / LENGTH_UNIT) + avatar.store["own_attributes"] + avatar.change(moved)
    radius = Schedule("code", 100, 30).rendering_radius(0.5)
    torch.testing.assert_close(got.scales[0], 0.00625 * raw[:, :3].sigmoid() + radius)
    torch.testing.assert_close(got.quats[0], raw[:, 3:7] / raw[:, 3:7].norm(dim=-1, keepdim=True))
    torch.testing.assert_close(got.opacities[0], raw[:, 7].sigmoid())
    torch.testing.assert_close(rgb_from_sh(got.sh[0, :, 0]), raw[:, 8:].sigmoid())
    (got.opacities.sum() + got.sh.sum() + got.scales.sum()).backward(retain_graph=True)
    assert means.grad is None, "they do not pull at points"
    got.means.sum().backward()
    assert means.grad is not None


def test_logits_of_scales_may_be_as_large_as_they_like() -> None:
    """The preset `paper` ends with some of 34."""
    avatar = new_avatar()
    own = avatar.store["own_attributes"].detach().clone()
    own[0, :3] = 40.0
    avatar.store.assign("own_attributes", own)
    assert baked_fault(avatar.bake()) is None


def test_schedules_are_those_of_paper_and_code() -> None:
    schedules: dict[ScheduleName, Schedule] = {name: Schedule(name, 130, 400) for name in ("code", "paper")}
    # Radii in the paper's lengths.
    code, paper = ([4 * one.rendering_radius(epoch / 130) for epoch in range(130)] for one in schedules.values())
    expected = {0: 8.44e-2, 4: 8.44e-2, 5: 6.3e-2, 30: 1.5e-2, 60: 7.6e-3, 80: 2.4e-3, 100: 7.6e-4, 120: 2.4e-4}
    assert {epoch: code[epoch] for epoch in expected} == pytest.approx(expected, rel=0.02)
    # The paper's shrinks: every 5 epochs up to 40, every 10 up to 60, every 5 up to 100.
    shrinks = [*range(5, 45, 5), 50, 60, *range(65, 105, 5)]
    assert paper == pytest.approx([8.4375e-2 * 0.75 ** sum(epoch >= at for at in shrinks) for epoch in range(130)])
    counts = {
        "code": {0: 400, 5: 800, 10: 1600, 25: 10_000, 29: 10_000, 35: 20_000, 45: 40_000, 50: 80_000, 60: 100_000},
        "paper": {0: 400, 5: 800, 10: 1600, 25: 10_000, 30: 20_000, 35: 40_000, 40: 80_000, 49: 80_000, 50: 100_000},
    }
    for name, schedule in schedules.items():
        assert {epoch: schedule.points_at(epoch / 130) for epoch in counts[name]} == counts[name]
        assert schedule.sampling_length(100 / 130) == schedule.rendering_radius(100 / 130)
    settings = new_avatar(plain_mono_gaussian_avatar(max_points=5000)).density().settings
    assert (settings.targets[:5], settings.targets[18:]) == ((400,) * 4 + (800,), (3200,) + (5000,) * 80)
    assert (settings.times[::98], settings.prune_opacity) == ((0.01, 0.99), 0.1)
    decays = [Schedule("code", 100, 400).face_decay(epoch / 100) for epoch in (0, 20, 30, 50, 70, 99)]
    assert decays == [1, 0.5, 0.25, 0.125, 0.0625, 0.0625]


def test_the_round_into_the_late_epoch_is_the_first_with_the_late_length() -> None:
    """A round runs after the last step of an epoch. It is 101 in `paper`, and the defaults begin one round later."""
    for late_epoch in (101, 102):
        schedule = Schedule("code", 130, 400, late_epoch=late_epoch)
        lengths = {epoch: 4 * schedule.sampling_length((epoch - 0.01) / 130) for epoch in range(99, 105)}
        assert [epoch for epoch, length in lengths.items() if length == 0.004] == list(range(late_epoch, 105))
    avatar = new_avatar(replace(SMALL, late_epoch=40))
    parents, noise = torch.tensor([3]), torch.tensor([[0.5, 0.0, 0.0]])
    children = avatar.density().refill(avatar.store, parents, noise, 39.5 / 100)["means"]
    torch.testing.assert_close(children - avatar.store["means"][parents], torch.tensor([[0.0005, 0, 0]]))


def test_children_are_around_their_parents() -> None:
    parents, noise = torch.tensor([3, 7]), torch.tensor([[0.5, -0.5, 0.0], [0.1, 0.2, 0.3]])
    lengths: dict[ScheduleName, Tensor] = {"code": torch.ones(2, 1), "paper": noise.norm(dim=-1, keepdim=True)}
    for name, length in lengths.items():
        avatar = new_avatar(replace(SMALL, schedule=name))
        children = avatar.density().refill(avatar.store, parents, noise, 0.3)["means"]
        away = (children - avatar.store["means"][parents]) / Schedule(name, 100, 30).rendering_radius(0.3)
        torch.testing.assert_close(away, noise / length, atol=1e-5, rtol=0)
        avatar.store.append(parents, {"means": children})
        own = avatar.store["own_attributes"]
        assert torch.equal(own[30:], own[parents]), "children inherit what is their parents' own"


def test_rates_halve_at_their_times() -> None:
    constant = Rate(1e-3)
    config = replace(SMALL, network_rate=constant, own_rate=constant, means_rate=constant, rate_halvings=(0.5, 0.75))
    for group in new_avatar(config).parameter_groups():
        rates = [group.rate_at(Progress(step, 100)) / group.rate_at(Progress(0, 100)) for step in (0, 49, 50, 75, 99)]
        assert rates == [1, 1, 0.5, 0.25, 0.25], group.name


def test_points_may_have_adams_own_epsilon_and_no_attributes_of_their_own() -> None:
    for epsilon, config in ((1e-8, replace(SMALL, adam_epsilon=1e-8)), (1e-15, SMALL)):
        assert {group.epsilon for group in new_avatar(config).parameter_groups()} == {epsilon}
    avatar, face = new_avatar(replace(SMALL, own_rate=Rate(0.0))), toy_face(5)[2]
    assert avatar.store.names() == ("means",)
    assert [group.name for group in avatar.parameter_groups()] == ["means", "attributes", "deformation", "change"]
    trained, baked = avatar.pose(face).gaussians, avatar.eval().pose(face).gaussians
    torch.testing.assert_close(baked.sh, trained.sh, atol=1e-5, rtol=0)


def test_starts_on_a_sphere_with_gray_translucent_points() -> None:
    avatar = new_avatar(disturbed=False)
    gaussians = avatar.pose(toy_face(5)[0], Progress(0, 100)).gaussians
    torch.testing.assert_close(avatar.store["means"].norm(dim=-1), torch.full((30,), 0.125))
    assert ((gaussians.opacities > 0.1) & (gaussians.opacities < 0.9)).all()
    # 0.0844 in the paper's lengths, which are four times ours, and the networks' share.
    assert ((gaussians.scales > 0.0211) & (gaussians.scales < 0.0211 + 0.00625)).all()


def test_points_start_on_the_canonical_face() -> None:
    avatar = new_avatar(replace(SMALL, start="face", points=200), disturbed=False)
    vertices, means = avatar.face_model.head_vertices(avatar.canonical_face())[0], avatar.store["means"]
    middles, _, normals = triangle_geometry(vertices, avatar.face_model.faces)
    # Each point lies in the plane of a triangle.
    assert ((means[:, None] - middles) * normals).sum(-1).abs().amin(1).max() < 1e-6
    assert len(means.unique(dim=0)) == 200


@pytest.mark.unchecked
def test_lessons_teach_the_motion_of_the_face_model() -> None:
    face = toy_face(5)

    def error(pretraining: int) -> float:
        avatar = new_avatar(replace(SMALL, start="face", points=200, pretraining=pretraining), disturbed=False)
        torch.manual_seed(1)
        triangles, weights = random_places(avatar.at_rest().vertices, avatar.face_model.faces, 200)
        corners = avatar.face_model.faces[triangles]
        avatar.store.assign("means", at_places(avatar.at_rest().vertices, corners, weights))
        taught = avatar.extras.pretraining
        assert (0 if taught is None else len(list(taught.run(face)))) == pretraining == (taught.count if taught else 0)
        target = at_places(avatar.face_model.head_vertices(face), corners, weights)
        return float((avatar.pose(face).gaussians.means - target).norm(dim=-1).mean().detach())

    assert error(60) < 0.5 * error(0)


def test_a_run_may_begin_at_a_later_epoch() -> None:
    whole, late = Schedule("code", 100, 400), Schedule("code", 100, 400, 60)
    assert whole.rendering_radius(1.0) == whole.rendering_radius(0.999), "the end of a run changes nothing"
    assert late.rounds() == tuple(epoch / 40 for epoch in range(1, 40))
    for fraction in (0.0, 0.25, 0.5, 0.975):
        for part in ("rendering_radius", "points_at", "face_decay"):
            assert getattr(late, part)(fraction) == getattr(whole, part)(0.6 + 0.4 * fraction)
    with pytest.raises(UserError, match="--method.epochs 60: give more than --method.first-epoch 60"):
        plain_mono_gaussian_avatar(epochs=60, first_epoch=60).check()


def softplus(values: Tensor) -> Tensor:
    return torch.nn.functional.softplus(values, beta=100)


def trunk_of(network: AttributeNet, encoding: Tensor) -> Tensor:
    """The values of the trunk, whose fourth layer sees the encoding again."""
    values = encoding
    for index, layer in enumerate(network.trunk):
        values = softplus(layer(torch.cat([values, encoding], -1) / 2**0.5 if index == 3 else values))
    return values


@pytest.mark.parametrize("every", [False, True])
def test_change_network_has_the_published_layers(every: bool) -> None:
    torch.manual_seed(0)
    network, values = AttributeChangeNet(16, every), torch.randn(9, 3)
    first, second, third = network.trunk
    trunk = third(second(first(values).relu()).relu())
    trunk = trunk.relu() if every else trunk  # the published code has no activation there
    heads = zip(network.heads, network.outputs, strict=True)
    expected = torch.cat([output(head(trunk).relu()) for head, output in heads], dim=-1)
    torch.testing.assert_close(network(values), expected)


@pytest.mark.parametrize("every", [False, True])
def test_attribute_network_has_the_published_layers(every: bool) -> None:
    torch.manual_seed(0)
    network, points = AttributeNet(48, 7, 6, every=every), torch.randn(9, 3)
    hidden = [softplus(head(trunk_of(network, positional_encoding(points, 6)))) for head in network.heads]
    hidden[3] = softplus(network.color(hidden[3])) if every else network.color(hidden[3])
    expected = torch.cat([output(one) for output, one in zip(network.outputs, hidden, strict=True)], dim=-1)
    torch.testing.assert_close(network(points), expected)
    assert [AttributeNet(48, layers, 6)(points).shape for layers in (2, 3, 4, 7)] == [(9, 11)] * 4


@torch.no_grad()
def test_attribute_network_starts_with_the_published_weights() -> None:
    torch.manual_seed(0)
    network = AttributeNet(256, 7, 6)
    layers: list[Any] = list(network.trunk)
    first, skip, last = (layers[index] for index in (0, 3, -1))
    # The waves have no effect at first, and the positions have no more than theirs.
    assert first.weight[:, 3:].abs().max() == skip.weight[:, -36:].abs().max() == 0
    assert float(first.weight[:, :3].std()) == pytest.approx((2 / 256) ** 0.5, rel=0.1)
    assert float(last.weight.mean()) == pytest.approx((torch.pi / 256) ** 0.5, rel=1e-3)
    assert float(last.weight.std()) == pytest.approx(1e-4, rel=0.1)
    assert last.bias.unique().tolist() == pytest.approx([-0.6])


def test_summed_directions_are_exactly_the_sums_of_directions() -> None:
    torch.manual_seed(0)
    network = DeformationNet(16, 4, 9, 5).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    values = points = torch.randn(7, 3).double()
    coefficients, found = torch.randn(2, 13).double(), network.whole(points)
    for layer in network.trunk:
        values = softplus(layer(values))
    directions = torch.cat([found.expression, found.pose], dim=-1)
    expected = network.directions(values).unflatten(-1, (3, 14))
    torch.testing.assert_close(torch.cat([found.offset[..., None], directions], dim=-1), expected)
    weights = (20 * network.skinning(softplus(network.hidden(values)))).softmax(-1)
    moved = torch.einsum("nxc,bc->bnx", directions, coefficients)
    torch.testing.assert_close(network(points, coefficients), (found.offset, moved, weights))
    torch.testing.assert_close(found.weights, weights)


def plain_layers(network: torch.nn.Module) -> set[str]:
    """Names of the layers without weight normalisation."""
    return {name.split(".")[0] for name, _ in network.named_parameters() if name.endswith(".weight")}


def test_layers_have_the_published_weight_norm_and_start() -> None:
    """Both branches of the deformation start as nothing, with even weights, and learn."""
    torch.manual_seed(0)
    forms: dict[WeightNorm, set[str]] = {"trunks": {"hidden"}, "code": set(), "paper": set()}
    for form, without in forms.items():
        network = DeformationNet(400, 4, 9, 5, form)
        assert plain_layers(network) == without | (set() if form == "paper" else {"directions", "skinning"})
        found = network.whole(torch.randn(7, 3))
        assert found.offset.abs().max() == found.expression.abs().max() == found.pose.abs().max() == 0
        torch.testing.assert_close(found.weights, torch.full((7, 5), 0.2))
        (found.expression.sum() + found.weights[:, 0].sum()).backward()
        gradients = {name: parameter.grad for name, parameter in network.named_parameters()}
        last = "parametrizations.weight.original0" if form == "paper" else "weight"
        assert known(gradients[f"directions.{last}"]).any()
        assert all(gradient is None or gradient.isfinite().all() for gradient in gradients.values())
        if form != "trunks":
            first = network.hidden.get_parameter("parametrizations.weight.original1").detach()
            assert float(first.std()) == pytest.approx((2 / 400) ** 0.5, rel=0.02)
    paper = new_avatar(replace(SMALL, weight_norm="paper"), disturbed=False)
    assert not plain_layers(paper.attributes) | plain_layers(paper.change) | plain_layers(paper.deformation)
    assert plain_layers(new_avatar().attributes) == {"heads", "color", "outputs"}
