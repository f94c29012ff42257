"""Splits, frame order, targets, also those that a worker prepares, and the optimiser do their parts of training."""

import threading
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import torch

import train_toy
from bounded_memory import MIB, allocating_at_most
from mien import _native
from mien.avatar.avatar import ParameterGroup, store_group
from mien.avatar.settings import Photometric, Progress, Rate
from mien.avatar.store import GaussianStore, Moments
from mien.gaussians import Rendering
from mien.training import train
from mien.training.adam import Adam
from mien.training.batch import AHEAD, targets_ahead
from mien.training.footage import frames as footage
from mien.training.footage.sequence import Sequence, Target, Targets, composite
from mien.training.losses import photometric_loss, picture_losses
from mien.training.settings import Split
from mien.training.trainer import start
from plain_settings import plain_gaussian_avatars, plain_run
from refusals import refuses
from toy_scene import rgb_from_sh, toy_sequence
from train_toy import stopped_at


@pytest.mark.parametrize(("timesteps", "split", "expected"), [
    (120, "blocks", [*range(40, 50), *range(90, 100)]),  # every fifth block of ten
    (5, "blocks", [4]),
    (30, "blocks", [*range(24, 30)]),
    (49, "blocks", [*range(36, 45)]),
    (101, "tail", [*range(81, 101)]),
    (104, "tail", [*range(83, 104)]),  # 20.8 timesteps are rounded, not cut
    (101, "none", []),
])  # fmt: skip
def test_splits(timesteps: int, split: Split, expected: list[int]) -> None:
    assert footage.held_out(timesteps, split).nonzero()[:, 0].tolist() == expected


def test_frames_leave_out_what_is_invalid_or_held_out_which_has_to_be_there() -> None:
    _, sequence = toy_sequence(60, 16)
    valid = np.ones((60, 1), dtype=bool)
    valid[3] = False
    second = replace(sequence, name="other", capture=replace(sequence.capture, valid=valid))
    frames = footage.training_frames([sequence, second], plain_run(split="blocks"))
    assert len(frames) == 50 + 49
    assert {frame.timestep for frame in frames if frame.sequence == 1} == set(range(60)) - {3} - set(range(40, 50))
    only = footage.training_frames([sequence, second], plain_run(split="none", held_out_sequences=("toy",)))
    assert {frame.sequence for frame in only} == {1}
    _, sequence = toy_sequence(12, 16)
    for settings, words in (
        (plain_run(held_out_sequences=("tyo",)), "--hold-out tyo: no such sequence in this run; there are: toy"),
        (plain_run(held_out_cameras=("back",)), "--hold-out-cameras back: no such camera; there are: front"),
        (plain_run(held_out_sequences=("toy",)), "leaves no sequence to train on"),
        (plain_run(held_out_cameras=("front",)), "no frame is left to train on"),
    ):
        refuses(words, footage.training_frames, [sequence], settings)


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
    for held_out_cameras, cameras in (((), (0, 1)), (("back",), (0,))):
        frames = footage.training_frames([ring], plain_run(split="none", held_out_cameras=held_out_cameras))
        assert [(frame.timestep, frame.camera) for frame in frames] == [(t, c) for t in range(5) for c in cameras]


def test_order_backgrounds_and_density_draws_depend_on_seed_and_step_only() -> None:
    frames = footage.training_frames([toy_sequence(12, 16)[1]], plain_run(split="none"))
    first, second, other = (
        [footage.FrameOrder(frames, seed).at(step) for step in range(start, start + 12)]
        for seed, start in ((5, 0), (5, 12), (6, 0))
    )
    for number, one in enumerate((first, second)):
        assert sorted(frame.timestep for frame, _ in one) == list(range(12))
        assert {passes for _, passes in one} == {number}
    assert [frame for frame, _ in first] != [frame for frame, _ in second]
    assert first != other
    settings = plain_run(background="random", seed=1)
    assert footage.background_at(settings, 3).tolist() != footage.background_at(settings, 4).tolist()
    assert footage.background_at(plain_run(background="white"), 3).tolist() == [255, 255, 255]
    mixed = [footage.background_at(replace(settings, background="mixed"), step).tolist() for step in range(400)]
    drawn = [step for step, color in enumerate(mixed) if color != [255, 255, 255]]
    assert 0.06 * 400 < len(drawn) < 0.14 * 400
    assert all(mixed[step] == footage.background_at(settings, step).tolist() for step in drawn)
    draws = [torch.rand(4, generator=footage.random_at(seed, footage.DENSITY, 3)) for seed in (1, 1, 2)]
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
    assert (large.reshape(16, 2, 16, 2, 3).mean((1, 3)) - small).abs().mean() < 2
    assert Targets(sequence, 4096).width == 32, "pictures are never enlarged"
    target, matte = full.target(1, 0, white, keep=True), sequence.scoring[1, 0]
    assert np.array_equal(target.picture.numpy(), composite(sequence.capture.images[1, 0], matte, white))
    assert np.array_equal(target.matte.numpy(), matte)
    assert target.box == cv2.boundingRect(matte)
    assert target.box[2] < 32


@pytest.mark.parametrize(("drawn", "matte"), [((3, 5), (20, 26)), ((30, 31), None), (None, (8, 9)), (None, None)])
def test_loss_inside_the_box_of_difference_is_that_of_the_whole_picture(drawn, matte) -> None:
    image, alpha = torch.ones(40, 40, 3), torch.zeros(40, 40)
    mask, picture = torch.zeros(40, 40, dtype=torch.uint8), torch.full((40, 40, 3), 255, dtype=torch.uint8)
    if drawn is not None:
        image[drawn], alpha[drawn] = 0.25, 0.9
    if matte is not None:
        picture[matte], mask[matte] = 10, 255
    rendering = Rendering(image, alpha, torch.zeros(1, dtype=torch.int32), torch.zeros(1, 2))
    target = Target(picture, mask, _native.box_of_nonzero(mask.float()), torch.ones(3))
    loss = picture_losses(rendering, target, Photometric(alpha_weight=0.5))
    torch.testing.assert_close(loss["photometric"], photometric_loss(image, picture, 0.8, 0.2))
    expected = 0.5 * ((drawn is not None) * 0.9 + (matte is not None)) / 1600
    assert loss["alpha"].item() == pytest.approx(expected)


def test_adam_equals_torchs_keeps_its_state_in_the_store_and_has_rates_that_fall() -> None:
    store = GaussianStore({"means": torch.linspace(-1, 1, 12).reshape(4, 3)})
    network, adam = torch.nn.Linear(3, 2), Adam()
    twins = [torch.nn.Parameter(tensor.detach().clone()) for tensor in (store["means"], *network.parameters())]
    rates = [{"params": twins[:1], "lr": 0.1}, {"params": twins[1:], "lr": 0.02}]
    reference = torch.optim.Adam(rates, eps=1e-15, foreach=False)
    for step in range(5):
        of_network = ParameterGroup("network", dict(network.named_parameters()), Rate(0.02))
        network(store["means"]).square().sum().backward()
        (twins[0] @ twins[1].T + twins[2]).square().sum().backward()
        adam.step([store_group(store, "means", Rate(0.1)), of_network], Progress(step, 5))
        reference.step()
        reference.zero_grad()
    torch.testing.assert_close([store["means"], *network.parameters()], twins)
    moments = store.moments["means"]
    assert isinstance(moments, Moments)
    assert (moments.step, set(adam.state())) == (5, {"network/weight", "network/bias"})
    assert store["means"].grad is None
    # Learning rates fall from start to end. One that starts at nothing stays there. A group may begin later.
    for rate, step, expected in (
        (Rate(1.0, 0.01), 50, 0.1), (Rate(1.0, 0.01), 100, 0.01), (Rate(0.3), 70, 0.3), (Rate(0.0, 1e-3), 50, 0.0),
    ):  # fmt: skip
        assert rate.at(Progress(step, 100)) == pytest.approx(expected, rel=1e-6, abs=0)
    late = ParameterGroup("late", {}, Rate(1.0), begin=0.5)
    assert [late.rate_at(Progress(step, 100)) for step in (49, 50)] == [0.0, 1.0]


def test_frames_with_rare_expressions_come_more_often() -> None:
    """Ninety timesteps at rest and ten with other expressions: the ten come twice as often as the median."""
    _, sequence = toy_sequence(100, 16)
    random = torch.Generator().manual_seed(0)
    expression = torch.cat([0.01 * torch.rand(90, 2, generator=random), torch.rand(10, 2, generator=random)])

    def tracked(expression: torch.Tensor) -> Sequence:
        face = replace(sequence.tracking.face, expression=expression)
        return replace(sequence, tracking=replace(sequence.tracking, face=face))

    frames = footage.training_frames([sequence], plain_run(split="none"))
    weights = footage.expression_rarity([tracked(expression)], frames)
    assert float(weights.min()) >= 0.5
    assert float(weights[90:].min()) == float(weights.max()) == 2
    assert float(weights[:90].median()) < 1.2
    order = footage.FrameOrder(frames, 5, weights)
    seen = [order.at(step)[0].timestep for step in range(1000)]
    expected = (weights / weights.sum() * 1000).numpy()
    assert np.abs(np.bincount(seen, minlength=100) - expected).max() < 6, "ten passes, each rounded by less than one"
    assert footage.FrameOrder(frames, 5, weights).at(777) == order.at(777), "a function of seed and step"
    assert seen[:100] != seen[100:200]
    # One expression only gives even weights.
    assert len(set(footage.expression_rarity([tracked(0 * expression)], frames).tolist())) == 1
    assert footage.expression_rarity([sequence], frames[:1]).isfinite().all()


@pytest.mark.unchecked
def test_first_colors_come_from_training_frames_only() -> None:
    face_model, sequence = toy_sequence(60, 24)

    def first(black: slice = slice(0), **changes: str) -> torch.Tensor:
        images = sequence.capture.images.copy()
        images[black] = 0
        given = replace(sequence, capture=replace(sequence.capture, images=images))
        state = start([given], face_model, plain_gaussian_avatars(**changes), plain_run(split="blocks"))
        return state.avatar.store["sh_constant"].detach()

    painted = first(first_colors="pictures")
    assert float((rgb_from_sh(first()) - 0.5).abs().max()) < 0.01
    assert float((rgb_from_sh(painted) - 0.5).abs().mean()) > 0.05
    for black, same in ((slice(40, 50), True), (slice(0, 10), False)):
        assert torch.equal(first(black, first_colors="pictures"), painted) == same


SETTINGS = plain_run(steps=40, split="none", background="random")


def workers() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("mien-targets")]


def test_native_composite_rounds_every_integer() -> None:
    random = np.random.default_rng(0)
    for width in (1, 7, 8, 50, 64) * 20:
        image = random.integers(0, 256, (9, width, 3), dtype=np.uint8)
        matte = np.repeat(random.choice([0, 0, 255, 255, 3, 254], (9, -(-width // 5))), 5, axis=1)[:, :width]
        matte = matte.astype(np.uint8)
        left, right = sorted(random.integers(0, width + 1, 2).tolist())
        inside = np.zeros((9, width), bool)
        inside[2:7, left:right] = True
        background = random.integers(0, 256, 3, dtype=np.uint8)
        for seen, box in ((matte, None), (matte * inside, (left, 2, right - left, 5))):
            total = image * seen[..., None].astype(int) + background * (255 - seen[..., None].astype(int))
            np.testing.assert_array_equal(composite(image, seen, background, box), (2 * total + 255) // 510)
    value, matte = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    image = np.repeat(value[..., None], 3, axis=2)
    for gray in (0, 1, 100, 255):
        found = composite(image, np.ascontiguousarray(matte), np.full(3, gray, np.uint8))
        total = value.astype(int) * matte + gray * (255 - matte.astype(int))
        np.testing.assert_array_equal(found[..., 0], (2 * total + 255) // 510)


@pytest.mark.parametrize("resolution", [0, 21])
@pytest.mark.parametrize("background", ["white", "mixed", "random"])
def test_the_queue_gives_the_targets_of_the_steps(resolution: int, background: str, monkeypatch) -> None:
    """No more targets wait than those of the next few steps."""
    sequence, settings, made = toy_sequence(6, 32)[1], replace(SETTINGS, background=background), []
    order = footage.FrameOrder(footage.training_frames([sequence], settings), 0)
    targets, alone = Targets(sequence, resolution), Targets(sequence, resolution)
    composed = targets.composed
    monkeypatch.setattr(targets, "composed", lambda *arguments: made.append(arguments) or composed(*arguments))
    with targets_ahead(order, lambda _: [targets], settings) as queue:
        for step in (*range(9), *range(30, 40), 3, 4):  # as a run that resumes, too
            found, (frame, _) = queue.target(step), order.at(step)
            own = alone.target(frame.timestep, frame.camera, footage.background_at(settings, step), keep=False)
            assert found.box == own.box
            for name in ("picture", "matte", "background"):
                assert getattr(found, name).equal(getattr(own, name)), (step, name)
    assert not workers()
    made.clear()
    with targets_ahead(order, lambda _: [targets], SETTINGS) as queue:
        for step in range(SETTINGS.steps):
            queue.target(step)
            assert len(made) <= step + 1 + AHEAD
    assert len(made) <= SETTINGS.steps, "nothing is made beyond the last step"


def test_the_worker_ends_with_an_error_of_its_own_and_with_an_interrupted_run(tmp_path, monkeypatch) -> None:
    face_model, sequence = toy_sequence(6, 32)
    run = partial(train, [sequence], face_model, train_toy.CONFIG, train_toy.SETTINGS)
    pytest.raises(KeyboardInterrupt, run, tmp_path / "stopped", stopped_at(1))
    assert not workers()

    def unreadable(*_: object, **__: object) -> Target:
        raise OSError("the disk is gone")

    monkeypatch.setattr(Targets, "composed", unreadable)
    with pytest.raises(OSError, match="the disk is gone"):
        run(tmp_path / "run")
    assert not workers()


@pytest.mark.unchecked
def test_the_pictures_of_a_long_capture_are_never_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pictures are all the same one in memory."""
    sequence, size = toy_sequence(80, 8)[1], 256
    one = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    images = np.broadcast_to(one, (80, 1, size, size, 3))
    mattes = images[..., 0]
    cameras = tuple(camera.resized(size, size) for camera in sequence.tracking.cameras)
    capture, tracking = replace(sequence.capture, images=images, mattes=mattes), sequence.tracking
    sequence = replace(sequence, capture=capture, scoring=mattes, tracking=replace(tracking, cameras=cameras))
    monkeypatch.setattr("mien.training.footage.sequence.CACHE_BYTES", 4 * MIB)
    settings = replace(SETTINGS, steps=80, background="white")
    order, targets = footage.FrameOrder(footage.training_frames([sequence], settings), 0), Targets(sequence, 0)
    with allocating_at_most(10 * MIB), targets_ahead(order, lambda _: [targets], settings) as queue:
        for step in range(settings.steps):
            queue.target(step)
