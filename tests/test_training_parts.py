"""Splits, frame order, targets, the optimiser and the face track do their parts of training."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mien.avatar import (
    FaceTuning,
    GaussianAvatarsConfig,
    GaussianStore,
    Moments,
    ParameterGroup,
    Photometric,
    Progress,
    Rate,
    store_group,
)
from mien.errors import UserError
from mien.face import FaceParams
from mien.gaussians import rgb_from_sh
from mien.render.rendering import Rendering
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.training import TrainSettings, held_out
from mien.training.adam import Adam
from mien.training.face_track import (
    FaceTrack,
    mean_pose_correction,
    spread_corrections,
    turns_from_mean,
    without_turns,
)
from mien.training.frames import (
    FrameOrder,
    background_at,
    density_random,
    expression_rarity,
    training_frames,
)
from mien.training.losses import picture_losses
from mien.training.photometric import photometric_loss
from mien.training.sequence import Target, Targets, composite
from mien.training.trainer import start, tuning_for
from toy_scene import toy_face, toy_sequence


def test_blocks_hold_out_every_fifth_block_of_ten() -> None:
    held = held_out(120, "blocks").nonzero()[:, 0].tolist()
    assert held == [*range(40, 50), *range(90, 100)]


@pytest.mark.parametrize(("timesteps", "expected"), [(5, [4]), (30, [*range(24, 30)]), (49, [*range(36, 45)])])
def test_short_clips_have_a_fifth_block_too(timesteps: int, expected: list[int]) -> None:
    assert held_out(timesteps, "blocks").nonzero()[:, 0].tolist() == expected


def test_tail_holds_out_the_last_fifth() -> None:
    assert held_out(101, "tail").nonzero()[:, 0].tolist() == list(range(81, 101))
    assert not held_out(101, "none").any()


def test_frames_leave_out_what_is_invalid_or_held_out() -> None:
    _, sequence = toy_sequence(60, 16)
    valid = np.ones((60, 1), dtype=bool)
    valid[3] = False
    second = replace(sequence, name="other", capture=replace(sequence.capture, valid=valid))
    frames = training_frames([sequence, second], TrainSettings(split="blocks"))
    assert len(frames) == 50 + 49
    assert {frame.timestep for frame in frames if frame.sequence == 1} == set(range(60)) - {3} - set(range(40, 50))
    only = training_frames([sequence, second], TrainSettings(split="none", held_out_sequences=("toy",)))
    assert {frame.sequence for frame in only} == {1}


def test_what_is_held_out_has_to_be_there() -> None:
    _, sequence = toy_sequence(12, 16)
    for settings, words in (
        (TrainSettings(held_out_sequences=("tyo",)), "--hold-out tyo: no such sequence in this run; there are: toy"),
        (TrainSettings(held_out_cameras=("back",)), "--hold-out-cameras back: no such camera; there are: front"),
        (TrainSettings(held_out_sequences=("toy",)), "leaves no sequence to train on"),
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
    frames = training_frames([ring], TrainSettings(split="none"))
    assert [(frame.timestep, frame.camera) for frame in frames] == [(t, c) for t in range(5) for c in range(2)]
    only = training_frames([ring], TrainSettings(split="none", held_out_cameras=("back",)))
    assert {frame.camera for frame in only} == {0}


def test_nothing_to_train_on_is_the_users_to_mend() -> None:
    _, sequence = toy_sequence(5, 16)
    with pytest.raises(UserError, match="no frame is left to train on"):
        training_frames([sequence], TrainSettings(held_out_cameras=("front",)))


def test_order_shows_each_frame_once_a_pass_and_depends_on_the_step_only() -> None:
    _, sequence = toy_sequence(12, 16)
    frames = training_frames([sequence], TrainSettings(split="none"))
    order = FrameOrder(frames, seed=5)
    passes = [[order.at(step)[0] for step in range(start, start + 12)] for start in (0, 12)]
    assert all(sorted(f.timestep for f in one) == list(range(12)) for one in passes)
    assert passes[0] != passes[1]
    assert FrameOrder(frames, seed=5).at(17) == (passes[1][5], 1)
    assert [FrameOrder(frames, seed=6).at(step)[0] for step in range(12)] != passes[0]


def test_random_backgrounds_and_density_draws_depend_on_seed_and_step() -> None:
    settings = TrainSettings(background="random", seed=1)
    assert background_at(settings, 3).tolist() == background_at(settings, 3).tolist()
    assert background_at(settings, 3).tolist() != background_at(settings, 4).tolist()
    assert background_at(TrainSettings(background="white"), 3).tolist() == [255, 255, 255]
    draws = [torch.rand(4, generator=density_random(replace(settings, seed=seed), 3)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


@given(st.integers(0, 2**31 - 1))
def test_composite_is_exact(seed: int) -> None:
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    matte = random.integers(0, 256, (5, 7), dtype=np.uint8)
    background = random.integers(0, 256, 3, dtype=np.uint8)
    alpha = matte[..., None] / 255
    expected = np.floor(image * alpha + background * (1 - alpha) + 0.5)
    got = composite(image, matte, background)
    assert got.dtype == np.uint8
    # Ties of rounding may fall either way in floating point.
    assert np.abs(got - expected).max() <= (0 if np.ptp(alpha) == 0 else 1)
    assert np.abs(got - (image * alpha + background * (1 - alpha))).max() <= 0.5 + 1e-9


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
    target = Targets(sequence, 0).target(2, 0, background, keep=False)
    whole = composite(sequence.capture.images[2, 0], sequence.scoring[2, 0], background)
    assert np.array_equal(target.picture.numpy(), whole)
    assert np.array_equal(target.matte.numpy(), sequence.scoring[2, 0])
    left, top, width, height = target.box
    assert sequence.scoring[2, 0][top : top + height, left : left + width].sum() == sequence.scoring[2, 0].sum()
    assert width < 32


def test_fixed_background_pictures_are_kept() -> None:
    _, sequence = toy_sequence(3, 16)
    targets, white = Targets(sequence, 0), np.full(3, 255, dtype=np.uint8)
    assert targets.target(1, 0, white, keep=True) is targets.target(1, 0, white, keep=True)
    grey = np.full(3, 99, dtype=np.uint8)
    assert targets.target(1, 0, grey, keep=False) is not targets.target(1, 0, grey, keep=False)


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
    assert store.moments["means"].step == 5
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


def test_face_track_moves_only_the_timestep_that_was_used() -> None:
    start, adam = toy_face(6), Adam()
    track = FaceTrack(start, FaceTuning(enabled=True, expression=Rate(0.01)))
    for step in range(4):
        face = track.face(2)
        (face.expression.sum() + face.head_translation.sum()).backward()
        adam.step(track.parameter_groups(2), Progress(step, 10))
    tuned = track.params()
    # Adam moves by its rate in each step while the gradient keeps its sign.
    torch.testing.assert_close(tuned.expression[2], start.expression[2] - 0.04)
    for other in (0, 1, 3, 4, 5):
        assert torch.equal(track.face(other).expression[0], start.expression[other])
    assert torch.equal(tuned.joints, start.joints), "what has no gradient does not move"
    resumed = FaceTrack(start, FaceTuning(enabled=True))
    resumed.load_state(track.state())
    assert torch.equal(resumed.params().expression, tuned.expression)


def test_face_track_is_still_where_tuning_is_off() -> None:
    track = FaceTrack(toy_face(6), FaceTuning(enabled=False))
    face = track.face(2)
    assert not face.expression.requires_grad
    assert track.parameter_groups(2) == []
    assert track.state() == {}


def test_tuned_expressions_stay_within_their_bounds_or_where_they_were_tracked() -> None:
    start, adam = toy_face(6), Adam()
    bounds = torch.tensor([[0.0, 1.0], [0.3, 0.4]])
    assert float(start.expression[0, 1]) < 0.3
    for within, lowest in ((True, [0.495, 0.0]), (False, None)):
        tuning = FaceTuning(expression=Rate(0.1), within_bounds=within)
        track = FaceTrack(start, tuning, bounds=bounds + torch.tensor([[0.495, 0.0], [0.0, 0.0]]))
        for step in range(4):
            track.face(0).expression.sum().backward()
            adam.step(track.parameter_groups(0), Progress(step, 10))
            track.confine(0)
        expected = torch.tensor(lowest) if lowest else start.expression[0] - 0.4
        torch.testing.assert_close(track.face(0).expression[0].detach(), expected)


def test_moments_begin_at_zero() -> None:
    moments = Moments.zeros(torch.ones(3))
    assert moments.first.eq(0).all()
    assert moments.step == 0


def test_corrections_spread_to_timesteps_that_were_not_seen() -> None:
    tracked = torch.arange(12.0).reshape(6, 2)
    seen = torch.tensor([False, True, False, False, True, False])
    correction = torch.tensor([[0.0, 0.0], [1.0, -2.0], [0.0, 0.0], [0.0, 0.0], [4.0, 1.0], [0.0, 0.0]])
    tuned = tracked + correction
    spread_corrections(tuned, tracked, seen)
    expected = torch.tensor([[1.0, -2.0], [1.0, -2.0], [2.0, -1.0], [3.0, 0.0], [4.0, 1.0], [4.0, 1.0]])
    torch.testing.assert_close(tuned - tracked, expected)


def test_corrections_of_a_timestep_stay_within_its_sequence() -> None:
    """Timestep 1 takes them from timestep 0; the third sequence, which is trained as well, does not."""
    track = FaceTrack(_still_face(6), FaceTuning(enabled=True), lengths=(2, 2, 2))
    indices = [track.index_of(sequence, timestep) for sequence in (0, 1, 2) for timestep in (0, 1)]
    assert indices == [0, 1, 2, 3, 4, 5]
    _push(track, 0, 1.0)
    _push(track, 4, -1.0)
    moved = track.params().head_translation
    assert (moved[0] < 0).all()
    torch.testing.assert_close(moved[1], moved[0])
    torch.testing.assert_close(moved[4:], -moved[:2])
    torch.testing.assert_close(moved[2:4], torch.zeros(2, 3))


def test_a_held_out_sequence_gets_the_mean_correction_of_the_pose() -> None:
    """The head of sequence 0 looks ahead, that of sequence 1, which is held out, looks aside: forward is sideways."""
    aside = torch.zeros(3, 3)
    aside[2, 1] = torch.pi / 2
    face = replace(_still_face(3), head_rotation=aside)
    track = FaceTrack(face, FaceTuning(enabled=True, head_translation=Rate(0.01), head_rotation=Rate(0.02)), (2, 1))
    _push(track, 0, 1.0, axes=(2,))
    tuned = track.params()
    torch.testing.assert_close(tuned.head_translation[0], torch.tensor([0.0, 0.0, -0.01]))
    torch.testing.assert_close(tuned.head_translation[2], torch.tensor([-0.01, 0.0, 0.0]))
    assert torch.equal(tuned.expression, face.expression), "expressions have no part that all timesteps share"


def test_the_mean_correction_is_given_in_the_head_frame() -> None:
    tracked = replace(_still_face(4), head_rotation=torch.randn(4, 3, generator=torch.Generator().manual_seed(0)))
    turn, shift = matrix_from_axis_angle(torch.tensor([0.02, -0.01, 0.03])), torch.tensor([0.001, 0.002, -0.003])
    rotation = tracked.T_world_head[:, :3, :3]
    tuned = replace(tracked, head_rotation=axis_angle_from_matrix(rotation @ turn), head_translation=rotation @ shift)
    found_turn, found_shift = mean_pose_correction(tracked, tuned)
    torch.testing.assert_close(found_turn, turn)
    torch.testing.assert_close(found_shift, shift)


@pytest.mark.parametrize("keeps", [True, False])
def test_a_shift_that_all_poses_share_is_taken_away(keeps: bool) -> None:
    """The heads look in four directions. The second half was never trained, and stays as it was tracked."""
    turns = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    tracked = replace(_still_face(4), head_rotation=turns)
    track = FaceTrack(tracked, FaceTuning(enabled=True, keep_mean_pose=keeps))
    shift = torch.tensor([0.001, 0.002, -0.003])
    for index in (0, 1):
        face, groups = track.face(index), track.parameter_groups(index)
        own = (1.5 if index else 0.5) * shift
        with torch.no_grad():
            face.head_translation[0] += tracked.T_world_head[index, :3, :3] @ own
        for group in groups:
            next(iter(group.moments.values())).step += 1
    track.steady_pose()
    moved = torch.cat([track.face(index).head_translation.detach() for index in range(4)]) - tracked.head_translation
    in_head = (tracked.T_world_head[:, :3, :3].mT @ moved[:, :, None])[:, :, 0]
    expected = (torch.tensor([-0.5, 0.5]) if keeps else torch.tensor([0.5, 1.5]))[:, None] * shift
    torch.testing.assert_close(in_head[:2], expected, atol=1e-6, rtol=0)
    assert moved[2:].abs().max() == 0


@pytest.mark.parametrize(("keeps", "mean"), [(True, True), (True, False), (False, True)])
def test_corrections_that_follow_the_turns_are_taken_away(keeps: bool, mean: bool) -> None:
    """A head turns by 20 degrees to both sides. Its corrections grow with the turn; one timestep has a larger one."""
    tracked = replace(_still_face(41), head_rotation=torch.zeros(41, 3))
    angles = torch.linspace(-0.35, 0.35, 41)
    tracked.head_rotation[:, 1] = angles
    track = FaceTrack(tracked, FaceTuning(enabled=True, keep_mean_pose=mean, keep_turns=keeps))
    with torch.no_grad():
        for index in range(41):
            face, groups = track.face(index), track.parameter_groups(index)
            face.head_rotation[0, 1] += 0.01 + 0.05 * angles[index] + (0.02 if index == 20 else 0.0)
            shift = torch.tensor([0.004, 0, 0]) * angles[index]
            face.head_translation[0] += tracked.T_world_head[index, :3, :3] @ shift
            for group in groups:
                next(iter(group.moments.values())).step += 1
    track.steady_pose()
    tuned = torch.cat([track.face(index).head_rotation.detach() for index in range(41)])[:, 1] - angles
    moved = torch.cat([track.face(index).head_translation.detach() for index in range(41)])
    slope = float(((tuned - tuned.mean()) * angles).sum() / angles.square().sum())
    assert slope == pytest.approx(0.0 if keeps else 0.05, abs=1e-3)
    assert float(moved.norm(dim=1).max()) == pytest.approx(0.0 if keeps else 0.0014, abs=5e-5)
    assert float(tuned.mean()) == pytest.approx(0.0 if mean else 0.01 + 0.02 / 41, abs=1e-4)
    assert float(tuned[20] - tuned[19]) == pytest.approx(0.02, abs=1e-3), "a timestep's own correction stays"


def test_a_head_that_hardly_turns_keeps_its_corrections() -> None:
    away = torch.zeros(40, 3, dtype=torch.float64)
    away[:, 1] = torch.linspace(-0.004, 0.004, 40)
    corrections = torch.zeros(40, 6)
    corrections[:, 3] = torch.linspace(-0.001, 0.001, 40)
    rest = without_turns(corrections, away, torch.zeros(40, dtype=torch.int64))
    torch.testing.assert_close(rest, corrections, atol=3e-5, rtol=0)


@pytest.mark.parametrize("count", [1, 2])
def test_corrections_may_follow_turns_that_several_cameras_see(count: int) -> None:
    _, sequence = toy_sequence(2, 16)
    cameras = tuple(sequence.tracking.cameras) * count
    seen = replace(sequence, tracking=replace(sequence.tracking, cameras=cameras))
    assert tuning_for(FaceTuning(keep_turns=True), [sequence, seen]).keep_turns == (count == 1)


def test_what_tells_sequences_apart_does_not_count_as_a_turn() -> None:
    """Two sequences look to different sides, and one of them is 4 mm off: neither follows turns within a sequence."""
    angles = torch.cat([torch.linspace(-0.4, -0.2, 20), torch.linspace(0.2, 0.4, 20)])
    tracked = replace(_still_face(40), head_rotation=torch.stack([0 * angles, angles, 0 * angles], 1))
    away, sequence = turns_from_mean(tracked), torch.arange(2).repeat_interleave(20)
    torch.testing.assert_close(away[:, 1].float(), angles, atol=1e-6, rtol=0)
    corrections = torch.zeros(40, 6)
    corrections[20:, 3] = 0.004
    torch.testing.assert_close(without_turns(corrections, away, sequence), corrections, atol=1e-9, rtol=0)
    corrections[:, 4] = 0.01 * angles
    rest = without_turns(corrections, away, sequence)
    assert float(rest[:, 4].abs().max()) < 0.2 * 0.004
    torch.testing.assert_close(rest[:, 3], corrections[:, 3], atol=1e-9, rtol=0)


def _still_face(timesteps: int) -> FaceParams:
    return FaceParams(
        identity=torch.zeros(1),
        expression=torch.zeros(timesteps, 1),
        joints=torch.zeros(timesteps, 1, 3),
        head_rotation=torch.zeros(timesteps, 3),
        head_translation=torch.zeros(timesteps, 3),
    )


def _push(track: FaceTrack, index: int, gradient: float, axes: tuple[int, ...] = (0, 1, 2)) -> None:
    """One step of Adam for a timestep whose head's translation has this gradient; the rest of it has none."""
    one = track.face(index)
    for name in ("expression", "joints", "head_rotation", "head_translation"):
        getattr(one, name).grad = torch.zeros_like(getattr(one, name))
    one.head_translation.grad = torch.zeros(1, 3).index_fill(1, torch.tensor(axes), gradient)
    Adam().step(track.parameter_groups(index), Progress(0, 10))


def test_frames_with_rare_expressions_come_more_often() -> None:
    """Ninety timesteps at rest and ten with other expressions: the ten come twice as often as the median."""
    _, sequence = toy_sequence(100, 16)
    expression = torch.zeros(100, 2)
    expression[:90] = 0.01 * torch.rand(90, 2, generator=torch.Generator().manual_seed(0))
    expression[90:] = torch.rand(10, 2, generator=torch.Generator().manual_seed(1))
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, expression=expression))
    sequence = replace(sequence, tracking=tracking)
    frames = training_frames([sequence], TrainSettings(split="none"))
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


def test_one_expression_only_gives_even_weights() -> None:
    _, sequence = toy_sequence(12, 16)
    still = replace(sequence.tracking.face, expression=torch.zeros(12, 2))
    sequence = replace(sequence, tracking=replace(sequence.tracking, face=still))
    frames = training_frames([sequence], TrainSettings(split="none"))
    assert len(set(expression_rarity([sequence], frames).tolist())) == 1
    assert expression_rarity([sequence], frames[:1]).isfinite().all()


def test_first_colours_come_from_training_frames_only() -> None:
    face_model, sequence = toy_sequence(60, 48)
    config, settings = GaussianAvatarsConfig(first_colors="pictures"), TrainSettings(split="blocks")
    painted = start([sequence], face_model, config, settings).avatar.gaussian_store()["sh_constant"]
    grey = start([sequence], face_model, GaussianAvatarsConfig(), settings).avatar.gaussian_store()["sh_constant"]
    assert float((rgb_from_sh(grey.detach()) - 0.5).abs().max()) < 0.01
    assert float((rgb_from_sh(painted.detach()) - 0.5).abs().mean()) > 0.05
    for timesteps, same in ((slice(40, 50), True), (slice(0, 10), False)):
        images = sequence.capture.images.copy()
        images[timesteps] = 0
        darker = replace(sequence, capture=replace(sequence.capture, images=images))
        again = start([darker], face_model, config, settings).avatar.gaussian_store()["sh_constant"]
        assert torch.equal(again, painted) == same
