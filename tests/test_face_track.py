"""The face track: tuned timesteps, corrections of those that were not seen, and what corrections may not follow."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from mien.avatar.settings import FaceTuning, Progress
from mien.face import FaceParams
from mien.training.adam import Adam
from mien.training.footage.face_track import FaceTrack, spread_corrections, turns_from_mean, without_turns
from mien.training.trainer import ALIGNED_TUNING, tuning_for
from toy_scene import toy_face, toy_sequence

ROUNDING = 1e-8
"""Largest error of sums over 40 float32 corrections of 4 mm, in metres. Processors add them in different orders."""


def still_face(timesteps: int, **changes: torch.Tensor) -> FaceParams:
    zeros = [torch.zeros(timesteps, *shape) for shape in ((1,), (1, 3), (3,), (3,))]
    return replace(FaceParams(torch.zeros(1), *zeros), **changes)


def push(track: FaceTrack, index: int, gradient: float, axes=(0, 1, 2), field: str = "head_translation") -> None:
    """One step of Adam for a timestep, one field of which has this gradient; its other gradients are 0."""
    one = track.face(index)
    for name in ("expression", "joints", "head_rotation", "head_translation"):
        getattr(one, name).grad = torch.zeros_like(getattr(one, name))
    getattr(one, field).grad = torch.zeros(1, 3).index_fill(1, torch.tensor(axes), gradient)
    Adam().step(track.parameter_groups(index), Progress(0, 10))


@torch.no_grad()
def correct(track: FaceTrack, tracked: FaceParams, index: int, shift: torch.Tensor, yaw: float = 0.0) -> None:
    """Move a head by a shift in its frame, and turn it, as if tuning had done it."""
    face, groups = track.face(index), track.parameter_groups(index)
    face.head_translation[0] += tracked.T_world_head[index, :3, :3] @ shift
    face.head_rotation[0, 1] += yaw
    for group in groups:
        moments: Any = next(iter((group.moments or {}).values()))
        moments.step += 1


def test_face_track_moves_only_the_timestep_that_was_used_within_its_bounds() -> None:
    start, adam = toy_face(6), Adam()
    track = FaceTrack(start, FaceTuning(enabled=True, expression=0.01))
    for step in range(4):
        face = track.face(2)
        (face.expression.sum() + face.head_translation.sum()).backward()
        adam.step(track.parameter_groups(2), Progress(step, 10))
    tuned = track.params()
    assert track.state()["expression.step"].tolist() == [0, 0, 4, 0, 0, 0], "each timestep has its own count"
    # Adam moves by its rate in each step while the gradient keeps its sign.
    torch.testing.assert_close(tuned.expression[2], start.expression[2] - 0.04)
    for other in (0, 1, 3, 4, 5):
        assert torch.equal(track.face(other).expression[0], start.expression[other])
    assert torch.equal(tuned.joints, start.joints), "what has no gradient does not move"
    resumed = FaceTrack(start, FaceTuning(enabled=True))
    resumed.load_state(track.state())
    assert torch.equal(resumed.params().expression, tuned.expression)
    still = FaceTrack(start, FaceTuning(enabled=False))
    assert not still.face(2).expression.requires_grad
    assert (still.parameter_groups(2), still.state()) == ([], {})
    start, adam = toy_face(6), Adam()
    bounds = torch.tensor([[0.0, 1.0], [0.3, 0.4]])
    assert float(start.expression[0, 1]) < 0.3
    for within, lowest in ((True, [0.495, 0.0]), (False, None)):
        tuning = FaceTuning(expression=0.1, within_bounds=within)
        track = FaceTrack(start, tuning, bounds=bounds + torch.tensor([[0.495, 0.0], [0.0, 0.0]]))
        for step in range(4):
            track.face(0).expression.sum().backward()
            adam.step(track.parameter_groups(0), Progress(step, 10))
            track.confine(0)
        expected = torch.tensor(lowest) if lowest else start.expression[0] - 0.4
        torch.testing.assert_close(track.face(0).expression[0].detach(), expected)


def test_corrections_spread_within_their_sequence_and_a_held_out_one_gets_the_mean_of_the_pose() -> None:
    tracked = torch.arange(12.0).reshape(6, 2)
    seen = torch.tensor([False, True, False, False, True, False])
    correction = torch.tensor([[0.0, 0.0], [1.0, -2.0], [0.0, 0.0], [0.0, 0.0], [4.0, 1.0], [0.0, 0.0]])
    tuned = tracked + correction
    spread_corrections(tuned, tracked, seen)
    expected = torch.tensor([[1.0, -2.0], [1.0, -2.0], [2.0, -1.0], [3.0, 0.0], [4.0, 1.0], [4.0, 1.0]])
    torch.testing.assert_close(tuned - tracked, expected)
    # Timestep 1 takes them from timestep 0; the third sequence, which is trained as well, does not.
    track = FaceTrack(still_face(6), FaceTuning(enabled=True), lengths=(2, 2, 2))
    assert [track.index_of(sequence, timestep) for sequence in (0, 1, 2) for timestep in (0, 1)] == list(range(6))
    push(track, 0, 1.0)
    push(track, 4, -1.0)
    moved = track.params().head_translation
    assert (moved[0] < 0).all()
    torch.testing.assert_close(moved, moved[0] * torch.tensor([1, 1, 0, 0, -1, -1])[:, None])
    # The head of sequence 0 looks ahead, that of sequence 1, which is held out, looks aside: forward is sideways.
    aside = torch.zeros(3, 3)
    aside[2, 1] = torch.pi / 2
    face = still_face(3, head_rotation=aside)
    track = FaceTrack(face, FaceTuning(enabled=True, head_translation=0.01, head_rotation=0.02), (2, 1))
    push(track, 0, 1.0, axes=(2,))
    tuned = track.params()
    moved = torch.tensor([[0.0, 0.0, -0.01], [-0.01, 0.0, 0.0]])
    torch.testing.assert_close(tuned.head_translation[[0, 2]], moved)
    assert torch.equal(tuned.expression, face.expression), "expressions have no part that all timesteps share"


@pytest.mark.parametrize("still", ["head_translation", "head_rotation"])
def test_a_field_that_is_not_tuned_keeps_no_correction_from_the_others(still: str) -> None:
    """With a rate of 0, as MonoGaussianAvatar's paper has for translations, a field takes no part in the tuning."""
    face, moving = still_face(3), "head_rotation" if still == "head_translation" else "head_translation"
    tuning = FaceTuning(enabled=True, keep_mean_pose=False, keep_turns=False)
    tuning = replace(tuning, **{moving: 0.01, still: 0.0})
    track = FaceTrack(face, tuning, (2, 1))
    push(track, 0, 1.0, (2,), moving)
    tuned = track.params()
    torch.testing.assert_close(getattr(tuned, moving)[2], torch.tensor([0.0, 0.0, -0.01]))
    assert torch.equal(getattr(tuned, still), getattr(face, still))


@pytest.mark.parametrize("keeps", [True, False])
def test_a_shift_that_all_poses_share_is_taken_away(keeps: bool) -> None:
    """The heads look in four directions. The second half was never trained, and stays as it was tracked."""
    tracked = still_face(4, head_rotation=torch.randn(4, 3, generator=torch.Generator().manual_seed(0)))
    track = FaceTrack(tracked, FaceTuning(enabled=True, keep_mean_pose=keeps))
    shift = torch.tensor([0.001, 0.002, -0.003])
    for index, share in enumerate((0.5, 1.5)):
        correct(track, tracked, index, share * shift)
    track.steady_pose()
    moved = torch.cat([track.face(index).head_translation.detach() for index in range(4)])
    in_head = (tracked.T_world_head[:, :3, :3].mT @ moved[:, :, None])[:, :, 0]
    expected = torch.tensor([-0.5, 0.5, 0, 0] if keeps else [0.5, 1.5, 0, 0])[:, None] * shift
    torch.testing.assert_close(in_head, expected, atol=1e-6, rtol=0)
    assert moved[2:].abs().max() == 0


@pytest.mark.parametrize(("keeps", "mean"), [(True, True), (True, False), (False, True)])
def test_corrections_that_follow_the_turns_are_taken_away(keeps: bool, mean: bool) -> None:
    """A head turns by 20 degrees to both sides. Its corrections grow with the turn; one timestep has a larger one."""
    angles = torch.linspace(-0.35, 0.35, 41)
    tracked = still_face(41, head_rotation=angles[:, None] * torch.tensor([0.0, 1.0, 0.0]))
    track = FaceTrack(tracked, FaceTuning(enabled=True, keep_mean_pose=mean, keep_turns=keeps))
    for index, angle in enumerate(angles.tolist()):
        yaw = 0.01 + 0.05 * angle + (0.02 if index == 20 else 0.0)
        correct(track, tracked, index, torch.tensor([0.004 * angle, 0, 0]), yaw)
    track.steady_pose()
    tuned = torch.cat([track.face(index).head_rotation.detach() for index in range(41)])[:, 1] - angles
    moved = torch.cat([track.face(index).head_translation.detach() for index in range(41)])
    slope = float(((tuned - tuned.mean()) * angles).sum() / angles.square().sum())
    assert slope == pytest.approx(0.0 if keeps else 0.05, abs=1e-3)
    assert float(moved.norm(dim=1).max()) == pytest.approx(0.0 if keeps else 0.0014, abs=5e-5)
    assert float(tuned.mean()) == pytest.approx(0.0 if mean else 0.01 + 0.02 / 41, abs=1e-4)
    assert float(tuned[20] - tuned[19]) == pytest.approx(0.02, abs=1e-3), "a timestep's own correction stays"


def test_what_is_not_trained_on_moves_no_other_pose_and_loses_the_same() -> None:
    """The last head is not trained on, and is then turned and corrected in another way."""
    angles, found = torch.linspace(-0.35, 0.35, 21), []
    for last, slope in ((0.35, 0.05), (2.0, -0.5)):
        heads = torch.cat([angles[:20], torch.tensor([last])])
        tracked = still_face(len(heads), head_rotation=torch.stack([2 * heads**2, heads, 0 * heads], 1))
        track = FaceTrack(tracked, FaceTuning(enabled=True, keep_mean_pose=True, keep_turns=True), trained=range(20))
        for index, angle in enumerate(heads.tolist()):
            correct(track, tracked, index, torch.zeros(3), 0.01 + (0.05 if index < 20 else slope) * angle)
        track.steady_pose()
        found.append(torch.cat([track.face(index).head_rotation.detach() for index in range(21)])[:, 1] - heads)
    assert found[0][:20].equal(found[1][:20])
    assert float(found[0].abs().max()) < 1e-3, "the last one followed its turn as well"


def test_aligned_faces_are_corrected_more_slowly() -> None:
    _, sequence = toy_sequence(2, 16)
    aligned = replace(sequence, tracking=replace(sequence.tracking, settings={"aligned": {"iterations": 2}}))
    both = replace(sequence, tracking=replace(sequence.tracking, cameras=tuple(sequence.tracking.cameras) * 2))
    tuning = FaceTuning(expression=2e-3, begin=0.5, keep_turns=True)
    assert tuning_for(tuning, [sequence, aligned]) == tuning
    assert not tuning_for(tuning, [sequence, both]).keep_turns
    slower, share = tuning_for(tuning, [aligned]), ALIGNED_TUNING
    assert slower.expression == share * 2e-3
    assert slower.begin == 0.5


def test_what_tells_sequences_apart_does_not_count_as_a_turn() -> None:
    """Two sequences look to different sides, and one of them is 4 mm off: neither follows turns within a sequence."""
    angles = torch.cat([torch.linspace(-0.4, -0.2, 20), torch.linspace(0.2, 0.4, 20)])
    tracked = still_face(40, head_rotation=torch.stack([0 * angles, angles, 0 * angles], 1))
    away, sequence = turns_from_mean(tracked), torch.arange(2).repeat_interleave(20)
    torch.testing.assert_close(away[:, 1].float(), angles, atol=1e-6, rtol=0)
    corrections = torch.zeros(40, 6)
    corrections[20:, 3] = 0.004
    torch.testing.assert_close(without_turns(corrections, away, sequence), corrections, atol=ROUNDING, rtol=0)
    corrections[:, 4] = 0.01 * angles
    rest = without_turns(corrections, away, sequence)
    assert float(rest[:, 4].abs().max()) < 0.2 * 0.004
    torch.testing.assert_close(rest[:, 3], corrections[:, 3], atol=ROUNDING, rtol=0)
    # A head that hardly turns keeps its corrections.
    corrections = torch.zeros(40, 6)
    corrections[:, 3] = torch.linspace(-0.001, 0.001, 40)
    away = torch.linspace(-0.004, 0.004, 40, dtype=torch.float64)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    rest = without_turns(corrections, away, 0 * sequence)
    torch.testing.assert_close(rest, corrections, atol=3e-5, rtol=0)
