"""The face track: tuned timesteps, corrections of those that were not seen, and what corrections may not follow."""

from dataclasses import replace

import pytest
import torch

from mien.avatar import FaceTuning, Moments, ParameterGroup, Progress, Rate
from mien.face import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.training.adam import Adam
from mien.training.constants import TRAINING
from mien.training.face_track import FaceTrack, mean_pose_correction, spread_corrections, turns_from_mean, without_turns
from mien.training.trainer import tuning_for
from toy_scene import toy_face, toy_sequence

ROUNDING = 1e-8
"""Largest error of sums over 40 float32 corrections of 4 mm, in metres. Processors add them in different orders."""


def count_step(group: ParameterGroup) -> None:
    """Count a step of the optimiser, as if the group had been tuned."""
    assert group.moments is not None
    moments = next(iter(group.moments.values()))
    assert isinstance(moments, Moments)
    moments.step += 1


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


@pytest.mark.parametrize("still", ["head_translation", "head_rotation"])
def test_a_field_that_is_not_tuned_keeps_no_correction_from_the_others(still: str) -> None:
    """With a rate of 0, as MonoGaussianAvatar's paper has for translations, a field takes no part in the tuning."""
    face, moving = _still_face(3), "head_rotation" if still == "head_translation" else "head_translation"
    tuning = FaceTuning(enabled=True, keep_mean_pose=False, keep_turns=False)
    tuning = replace(tuning, **{moving: Rate(0.01), still: Rate(0.0)})
    track = FaceTrack(face, tuning, (2, 1))
    _push(track, 0, 1.0, (2,), moving)
    tuned = track.params()
    torch.testing.assert_close(getattr(tuned, moving)[2], torch.tensor([0.0, 0.0, -0.01]))
    assert torch.equal(getattr(tuned, still), getattr(face, still))
    steady = FaceTrack(face, replace(tuning, keep_mean_pose=True), (2, 1))
    _push(steady, 0, 1.0, (2,), moving)
    steady.steady_pose()
    torch.testing.assert_close(getattr(steady.params(), moving), getattr(face, moving), atol=1e-8, rtol=0)


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
            count_step(group)
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
                count_step(group)
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


def test_aligned_faces_are_corrected_more_slowly() -> None:
    _, sequence = toy_sequence(2, 16)
    aligned = replace(sequence, tracking=replace(sequence.tracking, settings={"aligned": {"iterations": 2}}))
    tuning = FaceTuning(expression=Rate(1e-3, 1e-4), head_translation=Rate(3e-4, begin=0.5))
    assert tuning_for(tuning, [sequence, aligned]) == tuning
    slower = tuning_for(tuning, [aligned])
    share = TRAINING.aligned_tuning
    assert slower.expression == Rate(share * 1e-3, share * 1e-4)
    assert slower.head_translation == Rate(share * 3e-4, begin=0.5)


def test_what_tells_sequences_apart_does_not_count_as_a_turn() -> None:
    """Two sequences look to different sides, and one of them is 4 mm off: neither follows turns within a sequence."""
    angles = torch.cat([torch.linspace(-0.4, -0.2, 20), torch.linspace(0.2, 0.4, 20)])
    tracked = replace(_still_face(40), head_rotation=torch.stack([0 * angles, angles, 0 * angles], 1))
    away, sequence = turns_from_mean(tracked), torch.arange(2).repeat_interleave(20)
    torch.testing.assert_close(away[:, 1].float(), angles, atol=1e-6, rtol=0)
    corrections = torch.zeros(40, 6)
    corrections[20:, 3] = 0.004
    torch.testing.assert_close(without_turns(corrections, away, sequence), corrections, atol=ROUNDING, rtol=0)
    corrections[:, 4] = 0.01 * angles
    rest = without_turns(corrections, away, sequence)
    assert float(rest[:, 4].abs().max()) < 0.2 * 0.004
    torch.testing.assert_close(rest[:, 3], corrections[:, 3], atol=ROUNDING, rtol=0)


def _still_face(timesteps: int) -> FaceParams:
    return FaceParams(
        identity=torch.zeros(1),
        expression=torch.zeros(timesteps, 1),
        joints=torch.zeros(timesteps, 1, 3),
        head_rotation=torch.zeros(timesteps, 3),
        head_translation=torch.zeros(timesteps, 3),
    )


def _push(
    track: FaceTrack, index: int, gradient: float, axes: tuple[int, ...] = (0, 1, 2), field: str = "head_translation"
) -> None:
    """One step of Adam for a timestep, one field of which has this gradient; its other gradients are 0."""
    one = track.face(index)
    for name in ("expression", "joints", "head_rotation", "head_translation"):
        getattr(one, name).grad = torch.zeros_like(getattr(one, name))
    getattr(one, field).grad = torch.zeros(1, 3).index_fill(1, torch.tensor(axes), gradient)
    Adam().step(track.parameter_groups(index), Progress(0, 10))
