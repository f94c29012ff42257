"""Driving, neutral estimates and camera paths work in the avatar's own frame."""

import math
from dataclasses import replace

import pytest
import torch

from mien.avatar import neutral_of
from mien.camera import camera_from_fov
from mien.driving import drive
from mien.errors import UserError
from mien.face import FaceParams
from mien.render.camera_paths import orbit, turned_camera, turntable
from mien.rotation import axis_angle_from_matrix, matrix_from_axis_angle


def _face(timesteps: int, seed: int = 0, expressions: int = 6) -> FaceParams:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return FaceParams(
        identity=random(4),
        expression=random(timesteps, expressions).abs(),
        joints=0.2 * random(timesteps, 3, 3),
        head_rotation=0.3 * random(timesteps, 3),
        head_translation=0.1 * random(timesteps, 3),
        vertex_offsets=random(5, 3),
    )


def test_driving_an_avatar_with_itself_changes_nothing() -> None:
    face = _face(7)
    neutral = neutral_of(face)
    driven = drive(face, neutral, neutral)
    for name, tensor in face.tensors().items():
        torch.testing.assert_close(getattr(driven, name), tensor, atol=1e-5, rtol=1e-5)


def test_a_driver_at_rest_gives_the_avatar_at_rest_with_its_own_identity() -> None:
    avatar, driver = neutral_of(_face(9, 1)), neutral_of(_face(9, 2))
    driven = drive(driver, driver, avatar)
    for name, tensor in avatar.tensors().items():
        torch.testing.assert_close(getattr(driven, name), tensor, atol=1e-5, rtol=1e-5)


def test_motion_is_done_in_the_avatars_own_frame() -> None:
    """Motion is applied in the avatar's own frame: a driver filmed from the side makes it nod and move ahead."""
    driver_neutral = replace(neutral_of(_face(3)), head_rotation=torch.tensor([[0.0, math.pi / 2, 0.0]]))
    avatar = replace(neutral_of(_face(3, 5)), head_rotation=torch.zeros(1, 3))
    turn = matrix_from_axis_angle(driver_neutral.head_rotation)
    nod = torch.tensor([0.3, 0.0, 0.0])
    nodding = turn @ matrix_from_axis_angle(nod)
    ahead = (turn @ torch.tensor([0.0, 0.0, 0.1]))[0]
    driver = replace(
        driver_neutral,
        head_rotation=axis_angle_from_matrix(nodding),
        head_translation=driver_neutral.head_translation + ahead,
    )
    driven = drive(driver, driver_neutral, avatar)
    torch.testing.assert_close(driven.head_rotation[0], nod, atol=1e-5, rtol=0)
    moved = driven.head_translation[0] - avatar.head_translation[0]
    torch.testing.assert_close(moved, torch.tensor([0.0, 0.0, 0.1]), atol=1e-6, rtol=0)
    still = drive(driver, driver_neutral, avatar, with_head_pose=False)
    assert torch.equal(still.head_rotation, avatar.head_rotation)


def test_expression_is_relative_and_bounded() -> None:
    driver, avatar = _face(20, 3), _face(20, 4)
    bounds = torch.tensor([[0.0, 1.0]]).expand(6, 2)
    start, rest = neutral_of(driver), neutral_of(avatar)
    free, bounded = drive(driver, start, rest), drive(driver, start, rest, bounds)
    torch.testing.assert_close(free.expression, rest.expression + driver.expression - start.expression)
    torch.testing.assert_close(bounded.expression, free.expression.clamp(0, 1))
    assert len(bounded) == 20


def test_neutral_ignores_talking_and_a_bad_frame() -> None:
    face = _face(100)
    expression = face.expression.clone()
    rest = torch.tensor([0.3, 0.0, 0.0, 0.1, 0.0, 0.0])
    expression[40:60] = rest
    expression[70] = 50.0
    neutral = neutral_of(replace(face, expression=expression))
    torch.testing.assert_close(neutral.expression[0], rest)
    assert len(neutral) == 1


def test_other_face_models_are_refused() -> None:
    other = _face(3, expressions=5)
    with pytest.raises(UserError, match="different face models"):
        drive(other, neutral_of(other), neutral_of(_face(3)))


def test_turntable_keeps_the_center_in_its_place() -> None:
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    camera = camera_from_fov(0.5, 64, 48, viewmat)
    center = torch.tensor([0.02, 0.05, -0.6])
    path = turntable(camera, center, 8)
    place, depth = camera.project(center)
    for view in path:
        pixel, far = view.project(center)
        torch.testing.assert_close(pixel, place, atol=1e-3, rtol=0)
        torch.testing.assert_close(far, depth)
        assert float(view.position[1]) == pytest.approx(0, abs=1e-6)
    torch.testing.assert_close(path[0].viewmat, camera.viewmat)
    # A quarter turn, counter-clockwise from above (from +z towards +x), looks along -x.
    torch.testing.assert_close(path[2].position, center + torch.tensor([0.6, -0.05, 0.02]), atol=1e-6, rtol=0)
    opposite = path[4].position - center
    torch.testing.assert_close(opposite, torch.tensor([0.02, -0.05, -0.6]), atol=1e-5, rtol=0)


def test_swing_stays_within_its_span() -> None:
    camera = camera_from_fov(0.5, 64, 48, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    center = torch.tensor([0.0, 0.0, -0.6])
    path = turntable(camera, center, 8, span=1.0)
    torch.testing.assert_close(path[2].viewmat, orbit(camera, center, 0.5).viewmat)
    torch.testing.assert_close(path[6].viewmat, orbit(camera, center, -0.5).viewmat)
    torch.testing.assert_close(path[4].viewmat, camera.viewmat, atol=1e-6, rtol=0)


def test_a_camera_aside_looks_at_the_same_place() -> None:
    """A yaw of 90 degrees looks at the person's left side, a pitch of 30 from above, and 0 changes no bit."""
    camera = camera_from_fov(0.5, 64, 48, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    center = torch.tensor([0.0, 0.0, -0.6])
    left = turned_camera(camera, center, math.pi / 2, 0.0).position - center
    torch.testing.assert_close(left, torch.tensor([0.6, 0.0, 0.0]), atol=1e-6, rtol=0)
    above = turned_camera(camera, center, 0.0, math.pi / 6).position - center
    torch.testing.assert_close(above, torch.tensor([0.0, 0.3, 0.6 * math.sqrt(0.75)]), atol=1e-6, rtol=0)
    both = turned_camera(camera, center, math.pi / 2, math.pi / 6)
    torch.testing.assert_close(
        both.position - center, torch.tensor([0.6 * math.sqrt(0.75), 0.3, 0.0]), atol=1e-6, rtol=0
    )
    pixel, _ = both.project(center)
    torch.testing.assert_close(pixel, camera.project(center)[0], atol=1e-3, rtol=0)
    assert turned_camera(camera, center, 0.0, 0.0).viewmat.equal(camera.viewmat)
