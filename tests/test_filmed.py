"""What training saw of a face is measured, stored with the avatar, and softly kept to in driving."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toy
from mien import runtime
from mien.avatar import DEFAULT_METHOD, METHODS, Avatar, load_avatar, make_portable, measure_filmed, write_avatar
from mien.cli import main
from mien.commands.stages.viewing import viewed_file
from mien.driving import keep_to_filmed
from mien.errors import UserError
from mien.face import FaceParams
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.runtime.filmed import ROOM, head_angles, soft_limits, within_filmed_inputs, within_filmed_poses
from mien.training import read_coverage
from mien.training.footage.filmed import FILE
from plain_settings import plain_config
from toy_scene import toy_camera, toy_face_model, toy_sequence
from toy_workspace import write_toy_workspace

EYE = np.array([0.0, 0.0, 1.0])
PARTS = ("lowest", "highest", "directions", "reach", "head_angles")


def _face(yaws: list[float], expression: torch.Tensor | None = None) -> FaceParams:
    """Heads at the origin that turn to their left by some angles in radians."""
    count = len(yaws)
    rotation = torch.tensor([[0.0, yaw, 0.0] for yaw in yaws])
    values = torch.zeros(count, 3) if expression is None else expression
    return FaceParams(torch.zeros(2), values, torch.zeros(count, 2, 3), rotation, torch.zeros(count, 3))


def _filmed(yaws: list[float], expression: torch.Tensor | None = None) -> runtime.Filmed:
    face = _face(yaws, expression)
    return measure_filmed(face, _face([0.0]), torch.tensor(EYE).float().expand(len(face), 3))


def _avatar(face: FaceParams, method: str = DEFAULT_METHOD) -> Avatar:
    return METHODS[method].avatar(plain_config(method), toy_face_model(), face)


def _written(path: Path, avatar: Avatar, **changes: object) -> runtime.PortableAvatar:
    """Write an avatar as a .mien file, and read it."""
    portable = replace(make_portable(avatar, toy_camera(32), "toy"), **changes)
    runtime.write_portable(path, portable)
    return runtime.read_portable(path)


def test_soft_limits_change_nothing_inside_and_stay_below_their_limit() -> None:
    values = np.linspace(-5, 5, 1001)
    limited = soft_limits(values, np.array(-1.0), np.array(2.0), np.array(0.0), 1e-6)
    inside = (values >= -1) & (values <= 2)
    assert np.array_equal(limited[inside], values[inside])
    assert -(1 + ROOM) < limited.min() < limited.max() < 2 * (1 + ROOM)
    slopes = np.diff(limited) / np.diff(values)
    assert (slopes > 0).all(), "more motion of the driver is never less of the avatar"
    assert slopes.max() < 1 + 1e-9
    assert np.abs(np.diff(slopes)).max() < 0.08, "no kink"


def test_a_rare_combination_becomes_weaker_and_keeps_its_kind() -> None:
    """Either of two expressions was filmed at 1, never both together."""
    single = torch.cat([torch.eye(3)[:2].repeat(20, 1), torch.zeros(20, 3)])
    inputs = np.zeros((3, 9), np.float32)
    inputs[0, 0], inputs[1, :2], inputs[2, 2] = 1.0, 1.0, 1.5
    bounds = np.array([[0.0, 1.5]] * 3)
    kept = within_filmed_inputs(_filmed([0.0] * 60, single), inputs, np.zeros(9, np.float32), bounds)
    assert np.array_equal(kept[0], inputs[0]), "what was filmed keeps its bits"
    assert kept[1, 0] == pytest.approx(kept[1, 1], rel=1e-3)
    assert 0.6 < kept[1, 0] < 0.99
    assert 0 < kept[2, 2] < 0.3, "an expression that was never filmed is shown a little"


def test_the_camera_sees_the_head_from_sides_that_were_filmed() -> None:
    filmed = _filmed([-0.3, 0.1, 0.2])
    np.testing.assert_allclose(filmed.head_angles[0], [-0.2, 0.3], atol=1e-6)
    asked = _face([-0.25, 0.15, 1.2, -1.2])
    rotation, translation = asked.head_rotation.numpy(), asked.head_translation.numpy()
    kept = within_filmed_poses(filmed, rotation, translation, EYE)
    assert np.array_equal(kept[:2], rotation[:2])
    yaws = head_angles(kept, translation, EYE)[:, 0]
    assert -0.2 - math.radians(8) - 1e-6 < yaws[2] < -0.2
    assert 0.3 < yaws[3] < 0.3 + math.radians(8) + 1e-6
    looking_up = np.array([[-1.0, 0.0, 0.0]], np.float32)
    pitch = head_angles(within_filmed_poses(filmed, looking_up, translation[:1], EYE), translation[:1], EYE)[0, 1]
    assert -math.radians(8) < pitch < 0
    # A limited head keeps its roll.
    roll, turn = torch.tensor([0.0, 0.0, 0.4]), torch.tensor([0.0, 1.0, 0.0])
    rolled = axis_angle_from_matrix((matrix_from_axis_angle(turn) @ matrix_from_axis_angle(roll))[None]).numpy()
    kept = within_filmed_poses(_filmed([-0.1, 0.1]), rolled, translation[:1], EYE)
    up = matrix_from_axis_angle(torch.from_numpy(kept))[0, :, 1]
    assert math.atan2(-float(up[0]), float(up[1])) == pytest.approx(0.4, abs=0.08)


def test_driving_with_its_own_training_frames_changes_nothing() -> None:
    model, sequence = toy_sequence()
    face, eye = sequence.tracking.face, sequence.tracking.cameras[0].position
    subject = _avatar(face).subject
    filmed = measure_filmed(face, subject, eye.expand(len(face), 3))
    kept, softened = keep_to_filmed(face, filmed, subject, model.expression_bounds, eye)
    assert softened == 0
    for name, tensor in face.tensors().items():
        assert torch.equal(getattr(kept, name), tensor), name
    wild = replace(face, head_rotation=face.head_rotation + torch.tensor([0.0, 1.5, 0.0]))
    kept, softened = keep_to_filmed(wild, filmed, subject, model.expression_bounds, eye)
    assert softened == len(face)
    assert (kept.head_rotation - wild.head_rotation).abs().amax(1).min() > 0.3


def test_it_is_kept_in_a_run_and_in_a_mien_file_and_checked(tmp_path: Path) -> None:
    face = toy_sequence()[1].tracking.face
    avatar = _avatar(face)
    write_avatar(tmp_path / "a", avatar)
    assert load_avatar(tmp_path / "a").filmed is None
    assert _written(tmp_path / "a.mien", avatar).filmed is None
    avatar.filmed = good = measure_filmed(face, avatar.subject, torch.ones(len(face), 3))
    write_avatar(tmp_path / "a", avatar)
    for found in (load_avatar(tmp_path / "a").filmed, _written(tmp_path / "a.mien", avatar).filmed):
        assert found is not None
        assert all(np.array_equal(getattr(found, name), getattr(good, name)) for name in PARTS)
    for change in (
        {"lowest": good.highest + 1},
        {"reach": -np.ones(1, np.float32)},
        {"head_angles": good.head_angles[:, ::-1].copy()},
    ):
        avatar.filmed = replace(good, **change)
        write_avatar(tmp_path / "a", avatar)
        with pytest.raises(UserError, match="filmed"):
            load_avatar(tmp_path / "a")
        with pytest.raises(UserError, match="filmed"):
            _written(tmp_path / "a.mien", avatar)


@pytest.mark.parametrize("method", METHODS)
def test_a_confidence_that_does_not_fit_is_refused(method: str, tmp_path: Path) -> None:
    avatar = _avatar(toy_sequence()[1].tracking.face, method)
    good = np.full(len(toy_face_model().faces), 0.5, np.float32)
    found = _written(tmp_path / "a.mien", avatar, confidence=good)
    assert found.confidence is not None
    assert np.array_equal(found.confidence, good)
    wrong = [good + 1, good - 1, good * np.float32("nan")]
    wrong += [good[1:], good[:0]] if isinstance(found.baked, runtime.MeshBound) else []
    for confidence in wrong:
        with pytest.raises(UserError, match="confidence"):
            _written(tmp_path / "a.mien", avatar, confidence=confidence)


@pytest.mark.unchecked
@pytest.mark.parametrize("unseen", ["trained", "filled"])
def test_a_mien_file_and_the_viewer_have_the_confidence_of_the_run(unseen: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(train_toy, "SETTINGS", replace(train_toy.SETTINGS, steps=2, unseen=unseen))
    write_toy_workspace(tmp_path / "me")
    run, path = tmp_path / "me" / "runs" / "toy", tmp_path / "me.mien"
    covered = read_coverage(run, load_avatar(run).face_model)
    assert covered is not None
    assert covered.seen.unique().numel() > 1
    export = ["export", str(tmp_path / "me"), "--out", str(path)]
    assert main(export) == 0
    mesh = viewed_file(path).mesh
    assert mesh is not None
    for found in (runtime.read_portable(path).confidence, mesh.seen):
        assert found is not None
        assert np.array_equal(found, covered.seen.numpy())
    (run / FILE).unlink()
    assert main(export) == 0
    assert runtime.read_portable(path).confidence is None
