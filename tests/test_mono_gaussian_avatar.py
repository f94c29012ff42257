"""MonoGaussianAvatar follows its formulas."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from mien.avatar import MonoGaussianAvatar, MonoGaussianAvatarConfig, Progress, Rate
from mien.avatar.mono_gaussian_avatar.constants import MONO
from mien.avatar.mono_gaussian_avatar.motion import canonical_face
from mien.avatar.mono_gaussian_avatar.networks import Deformation, DeformationNet
from mien.avatar.mono_gaussian_avatar.schedule import Schedule, ScheduleName
from mien.avatar.mono_gaussian_avatar.settings import LENGTH_UNIT
from mien.avatar.surface_places import at_places, random_places
from mien.errors import UserError
from mien.face import FaceModel, FaceParams, head_poses
from mien.training import PRESETS
from mono_avatars import SMALL, new_avatar, pictured
from plain_settings import plain_mono_gaussian_avatar
from sh_colors import rgb_from_sh
from toy_scene import toy_face, toy_face_model


def with_pose_correctives() -> FaceModel:
    face_model = toy_face_model()
    torch.manual_seed(3)
    return replace(face_model, pose_basis=0.01 * torch.randn(9, len(face_model.template), 3))


def test_starts_on_a_sphere_with_gray_translucent_points() -> None:
    avatar = new_avatar(disturbed=False)
    gaussians = avatar.pose(toy_face(5)[0], Progress(0, 100)).gaussians
    torch.testing.assert_close(avatar.store["means"].norm(dim=-1), torch.full((30,), 0.125))
    assert ((gaussians.opacities > 0.1) & (gaussians.opacities < 0.9)).all()
    # 0.0844 in the paper's lengths, which are four times ours, and the networks' share.
    assert ((gaussians.scales > 0.0211) & (gaussians.scales < 0.0211 + 0.00625)).all()


def canonical_places(avatar: MonoGaussianAvatar) -> Tensor:
    means = avatar.store["means"]
    return means + LENGTH_UNIT * avatar.deformation.whole(means / LENGTH_UNIT).offset


def test_canonical_face_leaves_points_at_their_canonical_places() -> None:
    avatar = new_avatar(face_model=with_pose_correctives())
    canonical = avatar.canonical_face()
    posed = avatar.pose(canonical)
    torch.testing.assert_close(posed.gaussians.means[0], canonical_places(avatar), atol=1e-6, rtol=0)
    assert (avatar.pose(toy_face(5)[1]).gaussians.means - posed.gaussians.means).norm(dim=-1).max() > 1e-3


def test_canonical_jaw_is_open() -> None:
    """A jaw that follows the expression opens by its coefficient, a free one by its angle."""
    follows = toy_face_model()
    jaw = follows.joint_names.index("jaw")
    mean = toy_face(5).expression.mean(0)
    expression, joints = canonical_face(follows, mean)
    opening = follows.joint_rotation_basis[:, jaw, 0]
    assert float(expression @ opening) == pytest.approx(MONO.canonical_jaw, abs=1e-6)
    # Only the coefficient that opens the jaw most has changed.
    assert (expression != mean).nonzero()[:, 0].tolist() == [int(opening.argmax())]
    assert joints.abs().max() == 0
    free = replace(
        follows,
        joint_free=tuple(
            name == "jaw" or was for name, was in zip(follows.joint_names, follows.joint_free, strict=True)
        ),
        joint_rotation_basis=torch.zeros_like(follows.joint_rotation_basis),
    )
    expression, joints = canonical_face(free, mean)
    assert torch.equal(expression, mean)
    turned = joints[free.free_joint_names.index("jaw")]
    torch.testing.assert_close(turned, torch.tensor([MONO.canonical_jaw, 0, 0]))
    assert joints.abs().sum() == turned.abs().sum()
    headless = replace(follows, joint_names=tuple("chin" if name == "jaw" else name for name in follows.joint_names))
    assert torch.equal(canonical_face(headless, mean)[0], mean)


def test_a_point_on_the_still_bone_stays_in_the_world_while_the_head_moves() -> None:
    avatar, face = new_avatar(), toy_face(5)
    k = len(avatar.face_model.joint_names)
    with torch.no_grad():
        avatar.deformation.skinning.weight.zero_()
        avatar.deformation.skinning.bias.copy_(10.0 * torch.eye(k + 1)[k])
        avatar.deformation.directions.weight.zero_()
        avatar.deformation.directions.bias.zero_()
    face = replace(face, head_rotation=torch.randn(5, 3), head_translation=torch.randn(5, 3))
    world = [points_in_world(avatar, face[index]) for index in range(5)]
    for other in world[1:]:
        torch.testing.assert_close(other, world[0], atol=1e-5, rtol=0)
    with torch.no_grad():  # the head's bone
        avatar.deformation.skinning.bias.copy_(10.0 * torch.eye(k + 1)[0])
    assert (points_in_world(avatar, face[0]) - points_in_world(avatar, face[1])).abs().max() > 0.1


def points_in_world(avatar: MonoGaussianAvatar, face: FaceParams) -> Tensor:
    pose, means = head_poses(face)[0], avatar.pose(face).gaussians.means[0]
    return means @ pose[:3, :3].T + pose[:3, 3]


class Perfect(DeformationNet):
    """Deformation network that knows the face model's vertices."""

    def __init__(self, face_model: FaceModel) -> None:
        torch.nn.Module.__init__(self)
        self.model = face_model

    def whole(self, points: Tensor) -> Deformation:
        model, basis = self.model, self.model.pose_basis
        assert basis is not None
        expression = model.expression_basis.permute(1, 2, 0) / LENGTH_UNIT
        weights = torch.nn.functional.pad(model.skinning_weights, (0, 1))
        return Deformation(torch.zeros_like(points), expression, basis.permute(1, 2, 0) / LENGTH_UNIT, weights)

    def forward(self, points: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = self.whole(points)
        directions = torch.cat([found.expression, found.pose], dim=-1)
        return found.offset, torch.einsum("nxc,bc->bnx", directions, coefficients), found.weights


def perfect_avatar() -> MonoGaussianAvatar:
    """Return an avatar whose points are the canonical mesh's vertices."""
    avatar = new_avatar(face_model=with_pose_correctives())
    vertices = avatar.face_model.head_vertices(avatar.canonical_face())[0]
    avatar.store.resize(len(vertices))
    with torch.no_grad():
        avatar.store["means"].copy_(vertices)
    avatar.deformation = Perfect(avatar.face_model)  # type: ignore[assignment]
    return avatar


def test_vertices_with_their_own_directions_move_as_the_mesh_does_and_cost_nothing() -> None:
    avatar, face = perfect_avatar(), toy_face(5)
    gaussians = avatar.pose(face).gaussians
    torch.testing.assert_close(gaussians.means, avatar.face_model.head_vertices(face), atol=1e-6, rtol=0)
    assert gaussians.T_world_local is not None
    assert torch.equal(gaussians.T_world_local, head_poses(face))
    avatar.config = replace(SMALL, face_points=len(avatar.store))
    losses = avatar.regularizers(avatar.pose(face[1]), pictured(len(avatar.store)), Progress(0, 100))
    assert max(loss.item() for loss in losses.values()) < 1e-9


@pytest.mark.parametrize("source", ["code", "supplement"])
def test_losses_near_the_face_model_are_those_of_the_paper(source: str) -> None:
    face_model, by_code = with_pose_correctives(), source == "code"
    supplement: dict[str, Any] = {
        "face_expression_weight": 1e3,
        "face_expression_by_variance": False,
        "face_correctives_weight": 1e3,
    }
    paper = PRESETS["paper"].config("mono_gaussian_avatar")
    assert supplement == {name: getattr(paper, name) for name in supplement}
    avatar = new_avatar(replace(SMALL, face_points=12, **({} if by_code else supplement)), face_model)
    step = 4
    posed = avatar.pose(toy_face(5)[1], Progress(step, 100))
    losses = avatar.regularizers(posed, pictured(30), Progress(step, 100))
    # Points 48 .. 59, in turn, of 30.
    rows = torch.arange(18, 30)
    found = avatar.deformation.whole(avatar.store["means"][rows] / LENGTH_UNIT)
    vertices = face_model.head_vertices(avatar.canonical_face())[0]
    nearest = (canonical_places(avatar)[rows, None] - vertices).norm(dim=-1).argmin(1)
    weights = found.weights - torch.nn.functional.pad(face_model.skinning_weights[nearest], (0, 1))
    expected = 10 * 0.1 * weights.square().mean()
    torch.testing.assert_close(losses["skinning"], expected)
    assert face_model.pose_basis is not None
    # Lengths are four times life size.
    pose = found.pose - 4 * face_model.pose_basis[:, nearest].permute(1, 2, 0)
    expected = 10 * 10 * (10 * pose).square().mean() if by_code else 1000 * pose.square().mean()
    torch.testing.assert_close(losses["pose_correctives"], expected)
    variance = toy_face(5).expression.var(0, correction=0)
    # Coefficients and directions in units where the mean variance of coefficients is 1.
    unit = variance.mean()
    expression = unit.sqrt() * (found.expression - 4 * face_model.expression_basis[:, nearest].permute(1, 2, 0))
    of_code = 10 * 10 * ((10 * expression).square() / (variance / unit * 2)).mean()
    expected = of_code if by_code else 1000 * expression.square().mean()
    torch.testing.assert_close(losses["expression_directions"], expected)
    torch.stack(list(losses.values())).sum().backward()
    # The points do not feel these losses.
    assert avatar.store["means"].grad is None


def test_expressions_that_never_move_stay_finite() -> None:
    face = toy_face(5)
    still = replace(face, expression=face.expression * torch.tensor([1.0, 0.0]))
    for one in (still, replace(face, expression=0 * face.expression), face[0]):
        avatar = MonoGaussianAvatar(SMALL, toy_face_model(), one)
        losses = avatar.regularizers(avatar.pose(one[0]), pictured(30), Progress(0, 10))
        assert all(loss.isfinite() for loss in losses.values())


def test_attributes_are_those_at_rest_and_their_change() -> None:
    avatar, face = new_avatar(), toy_face(5)[3]
    got = avatar.pose(face, Progress(50, 100)).gaussians
    moved = (got.means[0] - canonical_places(avatar)) / LENGTH_UNIT
    raw = avatar.attributes(avatar.store["means"] / LENGTH_UNIT) + avatar.store["own_attributes"] + avatar.change(moved)
    radius = Schedule("code", 100, 30).rendering_radius(0.5)
    torch.testing.assert_close(got.scales[0], 0.00625 * raw[:, :3].sigmoid() + radius)
    torch.testing.assert_close(got.quats[0], raw[:, 3:7] / raw[:, 3:7].norm(dim=-1, keepdim=True))
    torch.testing.assert_close(got.opacities[0], raw[:, 7].sigmoid())
    torch.testing.assert_close(rgb_from_sh(got.sh[0, :, 0]), raw[:, 8:].sigmoid())
    # They do not pull at points.
    (got.opacities.sum() + got.sh.sum() + got.scales.sum()).backward(retain_graph=True)
    assert avatar.store["means"].grad is None
    got.means.sum().backward()
    assert avatar.store["means"].grad is not None


def radii(name: ScheduleName, epochs: int) -> dict[int, float]:
    """Radii by epoch, in the paper's lengths."""
    schedule = Schedule(name, epochs, 400)
    return {epoch: 4 * schedule.rendering_radius(epoch / epochs) for epoch in range(epochs)}


def test_schedules_are_those_of_paper_and_code() -> None:
    code, paper = radii("code", 130), radii("paper", 130)
    expected = {0: 8.44e-2, 4: 8.44e-2, 5: 6.3e-2, 30: 1.5e-2, 60: 7.6e-3, 80: 2.4e-3, 100: 7.6e-4, 120: 2.4e-4}
    for epoch, radius in expected.items():
        assert code[epoch] == pytest.approx(radius, rel=0.02), epoch
    # The paper's shrinks: every 5 epochs up to 40, every 10 up to 60, every 5 up to 100.
    shrinks = [*range(5, 45, 5), 50, 60, *range(65, 105, 5)]
    for epoch, radius in paper.items():
        assert radius == pytest.approx(8.4375e-2 * 0.75 ** sum(epoch >= at for at in shrinks)), epoch
    counts = {
        "code": {0: 400, 5: 800, 10: 1600, 25: 10_000, 29: 10_000, 35: 20_000, 45: 40_000, 50: 80_000, 60: 100_000},
        "paper": {0: 400, 5: 800, 10: 1600, 25: 10_000, 30: 20_000, 35: 40_000, 40: 80_000, 49: 80_000, 50: 100_000},
    }
    for name in ("code", "paper"):
        schedule = Schedule(name, 130, 400)
        assert {epoch: schedule.points_at(epoch / 130) for epoch in counts[name]} == counts[name]
        assert 4 * schedule.sampling_length(101 / 130) == 0.004
        assert schedule.sampling_length(100 / 130) == schedule.rendering_radius(100 / 130)
    decays = [Schedule("code", 100, 400).face_decay(epoch / 100) for epoch in (0, 20, 30, 50, 70, 99)]
    assert decays == [1, 0.5, 0.25, 0.125, 0.0625, 0.0625]


def test_the_round_into_epoch_101_is_the_first_with_the_late_length_in_paper() -> None:
    """A round runs after the last step of an epoch. The defaults begin one round later, as they were measured."""
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    assert (paper.late_epoch, SMALL.late_epoch) == (101, 102)
    for late_epoch in (101, 102):
        schedule = Schedule("code", 130, 400, late_epoch=late_epoch)
        lengths = {epoch: 4 * schedule.sampling_length((epoch - 0.01) / 130) for epoch in range(99, 105)}
        assert [epoch for epoch, length in lengths.items() if length == 0.004] == list(range(late_epoch, 105))
    avatar = new_avatar(replace(SMALL, late_epoch=40))
    parents, noise = torch.tensor([3]), torch.tensor([[0.5, 0.0, 0.0]])
    children = avatar.density().refill(avatar.store, parents, noise, 39.5 / 100)["means"]
    torch.testing.assert_close(children - avatar.store["means"][parents], torch.tensor([[0.0005, 0, 0]]))


def test_paper_has_adams_own_epsilon_and_the_published_skinning_branch() -> None:
    paper: Any = PRESETS["paper"].config("mono_gaussian_avatar")
    assert (paper.adam_epsilon, paper.skinning_norm) == (1e-8, True)
    for epsilon, config in ((1e-8, replace(SMALL, adam_epsilon=1e-8)), (1e-15, SMALL)):
        assert {group.epsilon for group in new_avatar(config).parameter_groups()} == {epsilon}


def test_rounds_grow_to_the_limit_and_no_further() -> None:
    settings = new_avatar(plain_mono_gaussian_avatar(max_points=5000)).density().settings
    targets = dict(zip(settings.times, settings.targets, strict=True))
    assert len(targets) == 99
    assert (targets[0.04], targets[0.05], targets[0.19], targets[0.2], targets[0.99]) == (400, 800, 3200, 5000, 5000)
    assert settings.prune_opacity == 0.1


def test_children_are_around_their_parents() -> None:
    parents, noise = torch.tensor([3, 7]), torch.tensor([[0.5, -0.5, 0.0], [0.1, 0.2, 0.3]])
    for name in ("code", "paper"):
        avatar = new_avatar(replace(SMALL, schedule=name))
        children = avatar.density().refill(avatar.store, parents, noise, 0.3)["means"]
        away = (children - avatar.store["means"][parents]) / Schedule(name, 100, 30).rendering_radius(0.3)
        if name == "code":
            torch.testing.assert_close(away, noise, atol=1e-5, rtol=0)
        else:
            torch.testing.assert_close(away.norm(dim=-1), torch.ones(2), atol=1e-5, rtol=0)
            assert (away * noise).sum(-1).min() > 0
        avatar.store.append(parents, {"means": children})
        own = avatar.store["own_attributes"]
        assert torch.equal(own[30:], own[parents]), "children inherit what is their parents' own"


def test_rates_halve_at_their_times() -> None:
    constant = Rate(1e-3)
    config = replace(SMALL, network_rate=constant, own_rate=constant, means_rate=constant, rate_halvings=(0.5, 0.75))
    avatar = new_avatar(config)
    for group in avatar.parameter_groups():
        rates = [group.rate_at(Progress(step, 100)) / group.rate_at(Progress(0, 100)) for step in (0, 49, 50, 75, 99)]
        assert rates == [1, 1, 0.5, 0.25, 0.25], group.name


def test_points_without_attributes_of_their_own() -> None:
    """The preset `paper` has none."""
    paper = PRESETS["paper"].config("mono_gaussian_avatar")
    assert isinstance(paper, MonoGaussianAvatarConfig)
    assert paper.own_rate == Rate(0.0)
    avatar = new_avatar(replace(SMALL, own_rate=Rate(0.0)))
    assert avatar.store.names() == ("means",)
    assert [group.name for group in avatar.parameter_groups()] == ["means", "attributes", "deformation", "change"]
    face = toy_face(5)[2]
    trained, baked = avatar.pose(face).gaussians, avatar.eval().pose(face).gaussians
    torch.testing.assert_close(baked.sh, trained.sh, atol=1e-5, rtol=0)


def test_points_start_on_the_canonical_face() -> None:
    avatar = new_avatar(replace(SMALL, start="face", points=200), disturbed=False)
    vertices = avatar.face_model.head_vertices(avatar.canonical_face())[0]
    a, b, c = vertices[avatar.face_model.faces].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    # Each point lies in the plane of a triangle.
    heights = ((avatar.store["means"][:, None] - a) * normals).sum(-1).abs().min(dim=1).values
    assert heights.max() < 1e-6
    assert len({tuple(point) for point in avatar.store["means"].tolist()}) == 200


@pytest.mark.unchecked
def test_lessons_teach_the_motion_of_the_face_model() -> None:
    face = toy_face(5)

    def error(pretraining: int) -> float:
        avatar = new_avatar(replace(SMALL, start="face", points=200, pretraining=pretraining), disturbed=False)
        torch.manual_seed(1)
        corners, weights = random_places(avatar.at_rest().vertices, avatar.face_model.faces, 200)
        with torch.no_grad():
            avatar.store["means"].copy_(at_places(avatar.at_rest().vertices, corners, weights))
        taught = avatar.extras.pretraining
        assert (0 if taught is None else len(list(taught.run(face)))) == pretraining == (taught.count if taught else 0)
        target = at_places(avatar.face_model.head_vertices(face), corners, weights)
        return float((avatar.pose(face).gaussians.means - target).norm(dim=-1).mean().detach())

    untaught = error(0)
    assert error(60) < 0.5 * untaught


def test_a_run_may_begin_at_a_later_epoch() -> None:
    whole, late = Schedule("code", 100, 400), Schedule("code", 100, 400, 60)
    assert whole.rendering_radius(1.0) == whole.rendering_radius(0.999), "the end of a run changes nothing"
    assert whole.rendering_radius(0.949) > whole.rendering_radius(0.95)
    assert late.rounds() == tuple(epoch / 40 for epoch in range(1, 40))
    for fraction in (0.0, 0.25, 0.5, 0.975):
        at = 0.6 + 0.4 * fraction
        assert late.rendering_radius(fraction) == whole.rendering_radius(at)
        assert late.points_at(fraction) == whole.points_at(at)
        assert late.face_decay(fraction) == whole.face_decay(at)
    with pytest.raises(UserError, match="--method.epochs 60: give more than --method.first-epoch 60"):
        plain_mono_gaussian_avatar(epochs=60, first_epoch=60).check()
