"""What docs/paper_preset.md says of the code beside its figures: the extent of cameras, optimisers and networks."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mien.avatar import GaussianAvatars, MonoGaussianAvatar, Progress, Rate
from mien.avatar.mono_gaussian_avatar.networks import ATTRIBUTES
from mien.camera import Camera
from mien.training import PRESETS, train
from mien.training.adam import Adam
from mien.training.density_control import density_strategy
from mien.training.face_track import FaceTrack
from mien.training.footage.constants import FOOTAGE
from mien.training.footage.frames import Frame, camera_extent
from plain_settings import plain_gaussian_avatars, plain_mono_gaussian_avatar, plain_run
from test_density import ABOVE, control, make_store, pose, random, rendering
from toy_scene import toy_face, toy_face_model, toy_sequence

PAPER: Any = PRESETS["paper"].config("gaussian_avatars")
STEPS = 600_000

# -- the extent of the cameras ----------------------------------------------------------------------------------------


def camera_at(*center: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -torch.tensor(center)
    return Camera(torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), viewmat, 16, 16)


def test_extent_is_that_of_the_training_cameras() -> None:
    _, sequence = toy_sequence(2, 16)
    cameras = (camera_at(0, 0, 0), camera_at(4, 0, 0), camera_at(2, 30, 0))
    rig = replace(sequence, tracking=replace(sequence.tracking, cameras=cameras))
    assert camera_extent([rig], [Frame(0, 0, 0), Frame(0, 1, 0), Frame(0, 0, 1)]) == pytest.approx(1.1 * 2)
    assert camera_extent([rig], [Frame(0, 0, 0)]) == FOOTAGE.least_extent == 0.5
    angles = torch.linspace(-math.pi / 4, math.pi / 4, 16).tolist()
    ring = tuple(camera_at(math.sin(angle), 0, math.cos(angle)) for angle in angles)
    arc = replace(sequence, tracking=replace(sequence.tracking, cameras=ring))
    assert camera_extent([arc], [Frame(0, 0, index) for index in range(16)]) == pytest.approx(0.8, abs=0.02)
    assert (PAPER.density.split_size, PAPER.density.prune_size) == (0.005 / FOOTAGE.least_extent, 0.05 / 0.5)
    near = replace(sequence, tracking=replace(sequence.tracking, cameras=(camera_at(0, 0, 0), camera_at(0.1, 0, 0))))
    assert camera_extent([near], [Frame(0, 0, 0), Frame(0, 0, 1)]) == FOOTAGE.least_extent


def test_extent_reaches_rates_in_its_unit_only() -> None:
    for config, factor in ((plain_gaussian_avatars(), 1), (plain_gaussian_avatars(means_times_extent=True), 3)):
        moved = []
        for extent in (1.0, 3.0):
            torch.manual_seed(0)
            avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
            store = avatar.gaussian_store()
            (store["means"].sum() + store["log_scales"].sum()).backward()
            Adam().step(avatar.parameter_groups(), Progress(0, 10, extent=extent))
            moved.append((float(store["means"].detach().abs().max()), float(store["log_scales"].detach().abs().max())))
        assert moved[1][0] == pytest.approx(factor * moved[0][0])
        assert moved[1][1] == moved[0][1]


def test_with_an_extent_of_0_nothing_moves_all_is_split_and_all_is_too_large() -> None:
    """The floor of E serves a single camera, and two that stand side by side."""
    avatar = GaussianAvatars(PAPER, toy_face_model(), toy_face(5))
    (means,) = [group for group in avatar.parameter_groups() if group.name == "means"]
    sizes = [1e-6, 0.0049, 0.0051, 0.06]
    expected = {  # faces of what is left, before and after step 60,000
        0.0: ([0, 0, 1, 1, 2, 2, 3, 3], [0, 0]),  # the last one stays, and is split
        FOOTAGE.least_extent: ([0, 0, 1, 1, 2, 2, 3, 3], [0, 0, 1, 1, 2, 2]),
    }
    for extent, (early, late) in expected.items():
        assert means.rate_at(Progress(0, STEPS, extent=extent)) == pytest.approx(5e-3 * extent)
        for step, faces in ((59_999, early), (61_999, late)):
            store = make_store(sizes)
            strategy = control(store, PAPER.density)
            strategy.observe(pose(store), rendering([ABOVE * 2] * len(sizes)))
            strategy.adapt(store, pose(store), Progress(step, STEPS, extent=extent), random)
            assert sorted(store["face_index"].tolist()) == faces, (extent, step)
            if step == 59_999:
                split = store["log_scales"].detach().exp()[:, 0] < 0.7 * torch.tensor(sizes)[store["face_index"]]
                cut = set(store["face_index"][split].tolist())
                assert cut == ({0, 1, 2, 3} if extent == 0 else {2, 3}), extent


# -- rates, moments and networks ---------------------------------------------------------------------------------------


def test_rates_of_expressions_count_only_with_a_rank() -> None:
    for rank, names in ((0, []), (2, ["color_basis", "opacity_basis"])):
        config = replace(
            PAPER, expression_rank=rank, expression_color_rate=Rate(0.1), expression_opacity_rate=Rate(0.1)
        )
        avatar = GaussianAvatars(config, toy_face_model(), toy_face(5))
        assert sorted(group.name for group in avatar.parameter_groups() if group.rate == Rate(0.1)) == names


def test_each_frame_has_moments_and_a_step_count_of_its_own() -> None:
    start, adam = toy_face(6), Adam()
    track = FaceTrack(start, replace(PAPER.face_tuning, expression=Rate(0.01)))
    for step, frame in enumerate((2, 2, 4)):
        track.face(frame).expression.sum().backward()
        adam.step(track.parameter_groups(frame), Progress(step, 10))
    counts = {
        name: tensor for name, tensor in track.state().items() if name.startswith("expression") and "step" in name
    }
    (count,) = counts.values()
    assert count.tolist() == [0, 0, 2, 0, 1, 0]
    moved = start.expression - torch.stack([track.face(index).expression[0].detach() for index in range(6)])
    torch.testing.assert_close(moved[:, 0], 0.01 * count)


@pytest.mark.unchecked
def test_a_stopped_run_of_the_preset_ends_as_if_it_had_not_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mien.training.trainer.camera_extent", lambda *_: 1.7)
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    settings = plain_run(steps=60, checkpoint_every=20, split="none")
    whole = train([sequence], face_model, PAPER, settings, tmp_path / "whole")
    train([sequence], face_model, PAPER, settings, tmp_path / "stopped")
    for file in (*(tmp_path / "stopped" / "checkpoints").glob("*60.safetensors"), tmp_path / "stopped/training.json"):
        file.unlink()
    again = train([sequence], face_model, PAPER, settings, tmp_path / "stopped")
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name


@pytest.fixture
def mono() -> MonoGaussianAvatar:
    """An avatar whose networks change attributes with motion."""
    torch.manual_seed(0)
    config = plain_mono_gaussian_avatar(points=40, max_points=60, own_rate=Rate(0.0))
    avatar = MonoGaussianAvatar(config, toy_face_model(), toy_face(5))
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return avatar


@pytest.mark.parametrize(("attribute", "drawn"), zip(ATTRIBUTES, ("scales", "quats", "opacities", "sh"), strict=True))
def test_each_head_predicts_its_own_attribute(attribute: str, drawn: str, mono: MonoGaussianAvatar) -> None:
    """In the published code, columns of scales and rotations are mixed up."""
    face, index = toy_face(5)[2], ATTRIBUTES.index(attribute)
    before = mono.pose(face, Progress(0, 100)).gaussians
    with torch.no_grad():
        layer: Any = mono.attributes.outputs[index]
        bias = layer.bias
        bias.add_(torch.linspace(0.5, 1, len(bias)))
    after = mono.pose(face, Progress(0, 100)).gaussians
    names = ("quats", "scales", "opacities", "sh")
    assert [name for name in names if not torch.equal(getattr(before, name), getattr(after, name))] == [drawn]


def test_a_turn_of_the_head_alone_changes_no_attribute_of_the_heads_own_points(mono: MonoGaussianAvatar) -> None:
    """In the published code, attributes change with the motion in the world."""
    with torch.no_grad():
        mono.deformation.skinning.bias[-1] = -1e3  # no point hangs on the bone that stands still
    face = toy_face(5)[2]
    turned = replace(face, head_rotation=face.head_rotation + 0.5)
    posed = [mono.pose(one, Progress(0, 100)).gaussians for one in (face, turned, toy_face(5)[0])]
    for name in ("scales", "quats", "opacities", "sh"):
        here, there, other = (getattr(one, name) for one in posed)
        torch.testing.assert_close(there, here, atol=1e-5, rtol=0)
        assert not torch.allclose(other, here, atol=1e-6), "an expression changes them"


def test_moments_of_points_and_networks_outlive_a_round(mono: MonoGaussianAvatar) -> None:
    """In the published code, each round makes a new optimiser, without moments."""
    adam: Adam = Adam()
    network: Any = mono.attributes.outputs[0]

    def step(gradient: float, number: int) -> None:
        for parameter in mono.parameters():
            parameter.grad = torch.full_like(parameter, gradient)
        adam.step(mono.parameter_groups(), Progress(number, 100))

    step(1.0, 0)
    strategy = density_strategy(mono.density(), mono.store)
    posed = mono.pose(toy_face(5)[0], Progress(0, 100))
    strategy.observe(posed, rendering([0.0] * len(mono.store)))
    assert strategy.adapt(mono.store, posed, Progress(0, 100), random)
    moments: Any = mono.store.moments["means"]
    assert (moments.step, len(moments.first)) == (1, len(mono.store))
    assert (moments.first != 0).any()
    before = network.bias.detach().clone()
    step(0.0, 1)
    assert (network.bias.detach() != before).all(), "momentum goes on without a gradient"
