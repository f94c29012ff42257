"""Splits, frame order, targets and the optimiser do their parts of training."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from mien.avatar import (
    GaussianStore,
    Moments,
    ParameterGroup,
    Photometric,
    Progress,
    Rate,
    store_group,
)
from mien.errors import UserError
from mien.render.rendering import Rendering
from mien.training import held_out
from mien.training.adam import Adam
from mien.training.footage.frames import (
    FrameOrder,
    background_at,
    density_random,
    expression_rarity,
    training_frames,
)
from mien.training.footage.sequence import Target, Targets, composite
from mien.training.losses import picture_losses
from mien.training.photometric import photometric_loss
from mien.training.settings import Split
from mien.training.trainer import start
from plain_settings import plain_gaussian_avatars, plain_run
from sh_colors import rgb_from_sh
from toy_scene import toy_sequence


@pytest.mark.parametrize(
    ("timesteps", "split", "expected"),
    [
        (120, "blocks", [*range(40, 50), *range(90, 100)]),  # every fifth block of ten
        (5, "blocks", [4]),
        (30, "blocks", [*range(24, 30)]),
        (49, "blocks", [*range(36, 45)]),
        (101, "tail", [*range(81, 101)]),
        (104, "tail", [*range(83, 104)]),  # 20.8 timesteps are rounded, not cut
        (101, "none", []),
    ],
)
def test_splits(timesteps: int, split: Split, expected: list[int]) -> None:
    assert held_out(timesteps, split).nonzero()[:, 0].tolist() == expected


def test_frames_leave_out_what_is_invalid_or_held_out() -> None:
    _, sequence = toy_sequence(60, 16)
    valid = np.ones((60, 1), dtype=bool)
    valid[3] = False
    second = replace(sequence, name="other", capture=replace(sequence.capture, valid=valid))
    frames = training_frames([sequence, second], plain_run(split="blocks"))
    assert len(frames) == 50 + 49
    assert {frame.timestep for frame in frames if frame.sequence == 1} == set(range(60)) - {3} - set(range(40, 50))
    only = training_frames([sequence, second], plain_run(split="none", held_out_sequences=("toy",)))
    assert {frame.sequence for frame in only} == {1}


def test_what_is_held_out_has_to_be_there() -> None:
    _, sequence = toy_sequence(12, 16)
    for settings, words in (
        (plain_run(held_out_sequences=("tyo",)), "--hold-out tyo: no such sequence in this run; there are: toy"),
        (plain_run(held_out_cameras=("back",)), "--hold-out-cameras back: no such camera; there are: front"),
        (plain_run(held_out_sequences=("toy",)), "leaves no sequence to train on"),
        (plain_run(held_out_cameras=("front",)), "no frame is left to train on"),
    ):
        with pytest.raises(UserError, match=words):
            training_frames([sequence], settings)


def test_calibrated_cameras_train_also_where_they_find_no_face() -> None:
    _, sequence = toy_sequence(6, 16)
    capture, tracking = sequence.capture, sequence.tracking
    both = replace(
        capture, camera_ids=("front", "back"), images=capture.images.repeat(2, 1), mattes=capture.mattes.repeat(2, 1),
        landmarks=capture.landmarks.repeat(2, 1), valid=np.array([[True, False]] * 6),
        principal_point=capture.principal_point.repeat(2, 0), calibration=tracking.cameras * 2,
    )  # fmt: skip
    seen = replace(tracking, valid=torch.tensor([True] * 5 + [False]), cameras=tracking.cameras * 2)
    ring = replace(sequence, capture=both, tracking=seen, scoring=sequence.scoring.repeat(2, 1))
    frames = training_frames([ring], plain_run(split="none"))
    assert [(frame.timestep, frame.camera) for frame in frames] == [(t, c) for t in range(5) for c in range(2)]
    only = training_frames([ring], plain_run(split="none", held_out_cameras=("back",)))
    assert {frame.camera for frame in only} == {0}


def test_order_shows_each_frame_once_a_pass_and_depends_on_the_step_only() -> None:
    _, sequence = toy_sequence(12, 16)
    frames = training_frames([sequence], plain_run(split="none"))
    order = FrameOrder(frames, seed=5)
    passes = [[order.at(step)[0] for step in range(start, start + 12)] for start in (0, 12)]
    assert all(sorted(f.timestep for f in one) == list(range(12)) for one in passes)
    assert passes[0] != passes[1]
    assert FrameOrder(frames, seed=5).at(17) == (passes[1][5], 1)
    assert [FrameOrder(frames, seed=6).at(step)[0] for step in range(12)] != passes[0]


def test_random_backgrounds_and_density_draws_depend_on_seed_and_step() -> None:
    settings = plain_run(background="random", seed=1)
    assert background_at(settings, 3).tolist() == background_at(settings, 3).tolist()
    assert background_at(settings, 3).tolist() != background_at(settings, 4).tolist()
    assert background_at(plain_run(background="white"), 3).tolist() == [255, 255, 255]
    mixed = [background_at(replace(settings, background="mixed"), step).tolist() for step in range(400)]
    drawn = [step for step, color in enumerate(mixed) if color != [255, 255, 255]]
    assert 0.06 * 400 < len(drawn) < 0.14 * 400
    assert all(mixed[step] == background_at(settings, step).tolist() for step in drawn)
    draws = [torch.rand(4, generator=density_random(replace(settings, seed=seed), 3)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_targets_at_half_resolution_show_the_same_view() -> None:
    _, sequence = toy_sequence(3, 32)
    full, half = Targets(sequence, 0), Targets(sequence, 16)
    assert (half.width, half.height) == (16, 16)
    point = torch.tensor([[0.02, 0.03, -0.45]])
    torch.testing.assert_close(half.camera(0).project(point)[0] * 2, full.camera(0).project(point)[0])
    white = np.full(3, 255, dtype=np.uint8)
    large, small = (targets.target(1, 0, white, keep=True).picture.float() for targets in (full, half))
    averaged = large.reshape(16, 2, 16, 2, 3).mean((1, 3))
    assert (averaged - small).abs().mean() < 2
    assert Targets(sequence, 4096).width == 32, "pictures are never enlarged"


def test_target_is_the_composite_of_the_whole_picture() -> None:
    _, sequence = toy_sequence(3, 32)
    background = np.array([10, 200, 99], dtype=np.uint8)
    targets = Targets(sequence, 0)
    target = targets.target(2, 0, background, keep=False)
    whole = composite(sequence.capture.images[2, 0], sequence.scoring[2, 0], background)
    assert np.array_equal(target.picture.numpy(), whole)
    assert np.array_equal(target.matte.numpy(), sequence.scoring[2, 0])
    left, top, width, height = target.box
    assert sequence.scoring[2, 0][top : top + height, left : left + width].sum() == sequence.scoring[2, 0].sum()
    assert width < 32
    assert targets.target(2, 0, background, keep=False) is not target
    assert targets.target(1, 0, background, keep=True) is targets.target(1, 0, background, keep=True)


@pytest.mark.parametrize(("drawn", "matte"), [((3, 5), (20, 26)), ((30, 31), None), (None, (8, 9)), (None, None)])
def test_loss_inside_the_box_of_difference_is_that_of_the_whole_picture(
    drawn: tuple[int, int] | None, matte: tuple[int, int] | None
) -> None:
    image, alpha = torch.full((40, 40, 3), 1.0), torch.zeros(40, 40)
    mask, picture = np.zeros((40, 40), dtype=np.uint8), torch.full((40, 40, 3), 255, dtype=torch.uint8)
    if drawn is not None:
        image[drawn[0], drawn[1]], alpha[drawn[0], drawn[1]] = 0.25, 0.9
    if matte is not None:
        picture[matte[0], matte[1]], mask[matte[0], matte[1]] = 10, 255
    rendering = Rendering(image, alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))
    left, top, width, height = cv2.boundingRect(mask)
    target = Target(picture, torch.from_numpy(mask), (left, top, width, height), torch.ones(3))
    loss = picture_losses(rendering, target, Photometric(alpha_weight=0.5))
    torch.testing.assert_close(loss["photometric"], photometric_loss(image, picture, 0.8, 0.2))
    expected = 0.5 * ((drawn is not None) * 0.9 + (matte is not None)) / 1600
    assert loss["alpha"].item() == pytest.approx(expected)


def test_gradient_of_the_loss_of_alpha_is_that_of_the_mean_difference() -> None:
    random = torch.Generator().manual_seed(0)
    alpha = torch.rand(7, 9, generator=random).requires_grad_()
    matte = torch.randint(0, 256, (7, 9), generator=random, dtype=torch.uint8)
    rendering = Rendering(torch.ones(7, 9, 3), alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))
    target = Target(torch.full((7, 9, 3), 255, dtype=torch.uint8), matte, (0, 0, 9, 7), torch.ones(3))
    (found,) = torch.autograd.grad(2 * picture_losses(rendering, target, Photometric(alpha_weight=0.5))["alpha"], alpha)
    (expected,) = torch.autograd.grad((alpha - matte / 255).abs().mean(), alpha)
    torch.testing.assert_close(found, expected)


def test_adam_equals_torchs_and_keeps_its_state_in_the_store() -> None:
    store = GaussianStore({"means": torch.linspace(-1, 1, 12).reshape(4, 3)})
    network = torch.nn.Linear(3, 2)
    twins = [torch.nn.Parameter(tensor.detach().clone()) for tensor in (store["means"], *network.parameters())]
    reference = torch.optim.Adam(
        [{"params": twins[:1], "lr": 0.1}, {"params": twins[1:], "lr": 0.02}], eps=1e-15, foreach=False
    )
    adam = Adam()
    for step in range(5):
        groups = [
            store_group(store, "means", Rate(0.1)),
            ParameterGroup("network", dict(network.named_parameters()), Rate(0.02)),
        ]
        network(store["means"]).square().sum().backward()
        (twins[0] @ twins[1].T + twins[2]).square().sum().backward()
        adam.step(groups, Progress(step, 5))
        reference.step()
        reference.zero_grad()
    for ours, theirs in zip((store["means"], *network.parameters()), twins, strict=True):
        torch.testing.assert_close(ours, theirs)
    moments = store.moments["means"]
    assert isinstance(moments, Moments)
    assert moments.step == 5
    assert set(adam.state()) == {"network/weight", "network/bias"}
    assert store["means"].grad is None


def test_rates() -> None:
    """Learning rates fall from start to end, after their beginning."""
    assert Rate(1.0, 0.01).at(Progress(50, 100)) == pytest.approx(0.1)
    assert Rate(1.0, 0.01).at(Progress(100, 100)) == pytest.approx(0.01)
    assert Rate(0.3).at(Progress(70, 100)) == 0.3
    late = Rate(1.0, 0.01, begin=0.5)
    assert (late.at(Progress(49, 100)), late.at(Progress(50, 100))) == (0.0, 1.0)
    assert late.at(Progress(75, 100)) == pytest.approx(0.1)


def test_frames_with_rare_expressions_come_more_often() -> None:
    """Ninety timesteps at rest and ten with other expressions: the ten come twice as often as the median."""
    _, sequence = toy_sequence(100, 16)
    expression = torch.zeros(100, 2)
    expression[:90] = 0.01 * torch.rand(90, 2, generator=torch.Generator().manual_seed(0))
    expression[90:] = torch.rand(10, 2, generator=torch.Generator().manual_seed(1))
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, expression=expression))
    sequence = replace(sequence, tracking=tracking)
    frames = training_frames([sequence], plain_run(split="none"))
    weights = expression_rarity([sequence], frames)
    assert float(weights.min()) >= 0.5
    assert float(weights[90:].min()) == float(weights.max()) == 2
    assert float(weights[:90].median()) < 1.2
    order = FrameOrder(frames, 5, weights)
    drawn = np.zeros(100)
    for step in range(1000):
        drawn[order.at(step)[0].timestep] += 1
    expected = (weights / weights.sum() * 1000).numpy()
    assert np.abs(drawn - expected).max() < 6, "ten passes, each rounded by less than one"
    assert FrameOrder(frames, 5, weights).at(777) == order.at(777), "a function of seed and step"
    passes = [[order.at(100 * number + step)[0] for step in range(100)] for number in range(2)]
    assert passes[0] != passes[1]
    # One expression only gives even weights.
    still = replace(tracking, face=replace(tracking.face, expression=torch.zeros(100, 2)))
    assert len(set(expression_rarity([replace(sequence, tracking=still)], frames).tolist())) == 1
    assert expression_rarity([sequence], frames[:1]).isfinite().all()


@pytest.mark.unchecked
def test_first_colors_come_from_training_frames_only() -> None:
    face_model, sequence = toy_sequence(60, 24)
    config, settings = plain_gaussian_avatars(first_colors="pictures"), plain_run(split="blocks")
    painted = start([sequence], face_model, config, settings).avatar.gaussian_store()["sh_constant"]
    grey = start([sequence], face_model, plain_gaussian_avatars(), settings).avatar.gaussian_store()["sh_constant"]
    assert float((rgb_from_sh(grey.detach()) - 0.5).abs().max()) < 0.01
    assert float((rgb_from_sh(painted.detach()) - 0.5).abs().mean()) > 0.05
    for timesteps, same in ((slice(40, 50), True), (slice(0, 10), False)):
        images = sequence.capture.images.copy()
        images[timesteps] = 0
        darker = replace(sequence, capture=replace(sequence.capture, images=images))
        again = start([darker], face_model, config, settings).avatar.gaussian_store()["sh_constant"]
        assert torch.equal(again, painted) == same
