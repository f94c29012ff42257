"""MonoGaussianAvatar follows its formulas."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mien.avatar import MonoGaussianAvatar, MonoGaussianAvatarConfig, Progress
from mien.avatar.mono_gaussian_avatar import (
    blend_transforms,
    face_decay,
    nearest_vertices,
    points_at,
    rendering_radius,
    unskin,
)
from mien.avatar.mono_networks import LENGTH_UNIT, AttributeChangeNet, AttributeNet, DeformationNet
from mien.face import FaceModel, head_poses
from mien.gaussians import rgb_from_sh
from mien.render.rendering import Rendering
from toy_scene import toy_face, toy_face_model

SMALL = MonoGaussianAvatarConfig(points=30, max_points=60)


def new_avatar(
    config: MonoGaussianAvatarConfig = SMALL, face_model: FaceModel | None = None, disturbed: bool = True
) -> MonoGaussianAvatar:
    torch.manual_seed(0)
    avatar = MonoGaussianAvatar(config, face_model or toy_face_model(), toy_face(5))
    if disturbed:
        with torch.no_grad():
            for network in (avatar.attributes, avatar.deformation, avatar.change):
                for parameter in network.parameters():
                    parameter.add_(0.05 * torch.randn(parameter.shape))
    return avatar


def with_pose_correctives() -> FaceModel:
    face_model = toy_face_model()
    torch.manual_seed(3)
    return replace(face_model, pose_basis=0.01 * torch.randn(9, len(face_model.template), 3))


def pictured(n: int) -> Rendering:
    return Rendering(torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.ones(n).int(), torch.zeros(n, 2))


def test_starts_on_a_sphere_with_grey_translucent_points() -> None:
    avatar = new_avatar(disturbed=False)
    gaussians = avatar.pose(toy_face(5)[0], Progress(0, 100)).gaussians
    torch.testing.assert_close(avatar.store["means"].norm(dim=-1), torch.full((30,), 0.125))
    assert ((gaussians.opacities > 0.1) & (gaussians.opacities < 0.9)).all()
    # 0.0844 in the paper's lengths, which are four times ours, and the networks' share.
    assert ((gaussians.scales > 0.0211) & (gaussians.scales < 0.0211 + 0.00625)).all()


def test_canonical_face_leaves_points_at_their_canonical_places() -> None:
    avatar = new_avatar(face_model=with_pose_correctives())
    canonical = avatar.canonical_face()
    torch.testing.assert_close(canonical.expression[0], toy_face(5).expression.mean(0))
    posed = avatar.pose(canonical)
    torch.testing.assert_close(posed.gaussians.means[0], posed.aux["canonical"], atol=1e-6, rtol=0)
    offset = avatar.deformation(avatar.store["means"] / LENGTH_UNIT)[0]
    torch.testing.assert_close(posed.aux["canonical"], avatar.store["means"] + LENGTH_UNIT * offset)
    assert (avatar.pose(toy_face(5)[1]).gaussians.means - posed.gaussians.means).norm(dim=-1).max() > 1e-3


class Perfect(torch.nn.Module):
    """Deformation network that knows the face model's vertices."""

    def __init__(self, face_model: FaceModel) -> None:
        super().__init__()
        self.model = face_model

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        model, basis = self.model, self.model.pose_basis
        assert basis is not None
        expression = model.expression_basis.permute(1, 2, 0) / LENGTH_UNIT
        return torch.zeros_like(points), expression, basis.permute(1, 2, 0) / LENGTH_UNIT, model.skinning_weights


def perfect_avatar() -> MonoGaussianAvatar:
    """Return an avatar whose points are the canonical mesh's vertices."""
    avatar = new_avatar(face_model=with_pose_correctives())
    vertices = avatar.face_model.head_vertices(avatar.canonical_face())[0]
    avatar.store.resize(len(vertices))
    with torch.no_grad():
        avatar.store["means"].copy_(vertices)
    avatar.deformation = Perfect(avatar.face_model)  # type: ignore[assignment]
    return avatar


def test_vertices_with_their_own_directions_move_as_the_mesh_does() -> None:
    avatar, face = perfect_avatar(), toy_face(5)
    gaussians = avatar.pose(face).gaussians
    torch.testing.assert_close(gaussians.means, avatar.face_model.head_vertices(face), atol=1e-6, rtol=0)
    assert gaussians.T_world_local is not None
    assert torch.equal(gaussians.T_world_local, head_poses(face))


def test_vertices_with_their_own_directions_cost_nothing() -> None:
    avatar = perfect_avatar()
    losses = avatar.regularizers(avatar.pose(toy_face(5)[1]), pictured(len(avatar.store)), Progress(0, 100))
    assert max(loss.item() for loss in losses.values()) < 1e-9


def test_losses_near_the_face_model_are_those_of_the_paper() -> None:
    face_model = with_pose_correctives()
    avatar = new_avatar(replace(SMALL, face_points=12), face_model)
    step = 4
    posed = avatar.pose(toy_face(5)[1], Progress(step, 100))
    losses = avatar.regularizers(posed, pictured(30), Progress(step, 100))
    # Points 48 .. 59, in turn, of 30.
    rows = torch.arange(18, 30)
    vertices = face_model.head_vertices(avatar.canonical_face())[0]
    nearest = (posed.aux["canonical"][rows, None] - vertices).norm(dim=-1).argmin(1)
    weights = posed.aux["weights"][rows] - face_model.skinning_weights[nearest]
    expected = 10 * 0.1 * weights.square().mean()
    torch.testing.assert_close(losses["skinning"], expected)
    assert face_model.pose_basis is not None
    # Lengths are four times life size.
    pose = 4 * (posed.aux["pose"][rows] - face_model.pose_basis[:, nearest].permute(1, 2, 0))
    torch.testing.assert_close(losses["pose_correctives"], 10 * 10 * (10 * pose).square().mean())
    variance = toy_face(5).expression.var(0, correction=0)
    # Coefficients and directions in units where the mean variance of coefficients is 1.
    unit = variance.mean()
    expression = (
        4 * unit.sqrt() * (posed.aux["expression"][rows] - face_model.expression_basis[:, nearest].permute(1, 2, 0))
    )
    expected = 10 * 10 * ((10 * expression).square() / (variance / unit * 2)).mean()
    torch.testing.assert_close(losses["expression_directions"], expected)


def test_expressions_that_never_move_stay_finite() -> None:
    face = toy_face(5)
    still = replace(face, expression=face.expression * torch.tensor([1.0, 0.0]))
    for one in (still, replace(face, expression=0 * face.expression), face[0]):
        avatar = MonoGaussianAvatar(SMALL, toy_face_model(), one)
        losses = avatar.regularizers(avatar.pose(one[0]), pictured(30), Progress(0, 10))
        assert all(loss.isfinite() for loss in losses.values())


def test_unskin_undoes_blended_transforms() -> None:
    torch.manual_seed(0)
    face_model = toy_face_model()
    face = replace(toy_face(5), joints=torch.randn(5, 1, 3))
    weights = torch.rand(20, 3).softmax(-1)
    transforms = blend_transforms(weights, face_model.joint_transforms(face))[2]
    points = torch.randn(20, 3)
    moved = torch.stack(
        [transform[:, :3] @ x + transform[:, 3] for transform, x in zip(transforms, points, strict=True)]
    )
    torch.testing.assert_close(unskin(moved, transforms), points, atol=1e-5, rtol=1e-5)


def test_attributes_are_those_at_rest_and_their_change() -> None:
    avatar, face = new_avatar(), toy_face(5)[3]
    posed = avatar.pose(face, Progress(50, 100))
    got = posed.gaussians
    moved = (got.means[0] - posed.aux["canonical"]) / LENGTH_UNIT
    raw = avatar.attributes(avatar.store["means"] / LENGTH_UNIT) + avatar.change(moved)
    torch.testing.assert_close(got.scales[0], 0.00625 * raw[:, :3].sigmoid() + rendering_radius(0.5))
    torch.testing.assert_close(got.quats[0], raw[:, 3:7] / raw[:, 3:7].norm(dim=-1, keepdim=True))
    torch.testing.assert_close(got.opacities[0], raw[:, 7].sigmoid())
    torch.testing.assert_close(rgb_from_sh(got.sh[0, :, 0]), raw[:, 8:].sigmoid())


def test_attributes_do_not_pull_at_points() -> None:
    avatar = new_avatar()
    gaussians = avatar.pose(toy_face(5)[1]).gaussians
    (gaussians.opacities.sum() + gaussians.sh.sum() + gaussians.scales.sum()).backward()
    assert avatar.store["means"].grad is None
    gaussians = avatar.pose(toy_face(5)[1]).gaussians
    gaussians.means.sum().backward()
    assert avatar.store["means"].grad is not None


def test_flattened_change_network_is_the_same_function() -> None:
    torch.manual_seed(0)
    network, values = AttributeChangeNet(16), torch.randn(9, 3)
    expected = network(values)
    weights, biases = network.flattened()
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        values = values @ weight.T + bias
        values = values.relu() if index < 3 else values
    torch.testing.assert_close(values, expected)


def test_deformation_starts_as_nothing_with_even_weights() -> None:
    offset, expression, pose, weights = DeformationNet(16, 4, 9, 5)(torch.randn(7, 3))
    assert offset.abs().max() == expression.abs().max() == pose.abs().max() == 0
    torch.testing.assert_close(weights, torch.full((7, 5), 0.2))


@pytest.mark.parametrize("layers", [2, 3, 4, 7])
def test_attribute_network_of_any_depth(layers: int) -> None:
    """The attribute network can have any depth."""
    assert AttributeNet(48, layers)(torch.randn(5, 3)).shape == (5, 11)


def test_schedules_are_the_papers() -> None:
    # Epochs over 100; the paper's radii are in lengths four times ours.
    epochs = {0: 8.44e-2, 4.9: 8.44e-2, 5: 6.3e-2, 30: 1.5e-2, 60: 7.6e-3, 80: 2.4e-3}
    for epoch, radius in epochs.items():
        assert rendering_radius(epoch / 100) == pytest.approx(radius / 4, rel=0.02)
    assert rendering_radius(1.0) == rendering_radius(0.99)
    counts = {0: 400, 5: 800, 10: 1600, 25: 10_000, 29: 10_000, 45: 40_000, 60: 100_000, 100: 100_000}
    assert {epoch: points_at(epoch / 100, 400) for epoch in counts} == counts
    assert [face_decay(time) for time in (0.0, 0.2, 0.3, 0.5, 0.7, 1.0)] == [1, 0.5, 0.25, 0.125, 0.0625, 0.0625]


def test_rounds_grow_to_the_limit_and_no_further() -> None:
    settings = new_avatar(MonoGaussianAvatarConfig(rounds=100, max_points=5000)).density().settings
    targets = dict(zip(settings.times, settings.targets, strict=True))
    assert (targets[0.04], targets[0.05], targets[0.19], targets[0.2], targets[0.99]) == (400, 800, 3200, 5000, 5000)
    assert settings.prune_opacity == 0.1


def test_children_are_in_a_cube_about_their_parents() -> None:
    avatar = new_avatar()
    parents, noise = torch.tensor([3, 7]), torch.tensor([[0.5, -0.5, 0.0], [0.1, 0.2, 0.3]])
    children = avatar.density().refill(avatar.store, parents, noise, 0.3)["means"]
    torch.testing.assert_close(children, avatar.store["means"][parents] + noise * rendering_radius(0.3))


def test_nearest_vertices() -> None:
    """Each point finds its nearest vertex."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = torch.tensor([[0.6, 0.1, 0], [0.1, 0.1, 5], [0.4, 0.55, 0]])
    assert nearest_vertices(points, vertices).tolist() == [1, 0, 2]
