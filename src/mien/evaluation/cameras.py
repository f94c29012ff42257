"""Camera paths for pictures of avatars."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.rotation import invert_rigid, matrix_from_axis_angle, rigid_transform

_WORLD_UP = (0.0, 1.0, 0.0)


def turntable(
    camera: Camera,
    centre: Float[Tensor, " 3"],
    frames: int,
    span: float = 2 * math.pi,
    up: tuple[float, float, float] = _WORLD_UP,
) -> list[Camera]:
    """Cameras that go once around `centre` at the distance, height and focal length of `camera`, the first of them.

    A `span` below a full turn swings instead: to span / 2 on the subject's left, back through the middle to the right
    and home, slowing down at the ends, so that the path loops either way.

    Args:
        camera: Where the path starts; the centre keeps its place in the picture.
        centre: What to go around, world space, metres (the head's: `FaceParams.head_translation`).
        frames: How many cameras.
        span: Radians, 2 pi for a full turn.
        up: The axis of the turn in world space.
    """
    phases = [2 * math.pi * index / frames for index in range(frames)]
    full = span >= 2 * math.pi
    return [orbit(camera, centre, phase if full else 0.5 * span * math.sin(phase), up) for phase in phases]


def orbit(
    camera: Camera, centre: Float[Tensor, " 3"], angle: float, up: tuple[float, float, float] = _WORLD_UP
) -> Camera:
    """`camera` carried around `centre` by `angle` radians, counter-clockwise seen from above."""
    axis = torch.nn.functional.normalize(camera.viewmat.new_tensor(up), dim=0)
    turn = matrix_from_axis_angle(axis * angle)
    centre = centre.to(camera.viewmat)
    # p -> turn (p - centre) + centre carries the camera; the world moves the other way.
    carry = rigid_transform(turn, centre - turn @ centre)
    return replace(camera, viewmat=camera.viewmat @ invert_rigid(carry))
