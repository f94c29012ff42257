"""Angles of camera paths around a head, and cameras in numpy, as `mien.render.camera_paths` has them in torch."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mien.runtime.avatar import Avatar
from mien.runtime.baked import Camera
from mien.runtime.rotation import matrix_from_axis_angle

_UP = (0.0, 1.0, 0.0)
_ZOOMS = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4)
"""Magnifications that are tried until a head is whole."""
_GLANCE, _FAINT = 128, 0.1
"""Largest side of the small pictures that tell where an avatar is, in pixels, and the opacity that counts."""


def fitted(camera: Camera, width: int, height: int, zoom: float = 1.0) -> Camera:
    """The same view in a picture of another shape: all of it is visible, centred, and magnified by `zoom`."""
    scale = min(width / camera.width, height / camera.height) * zoom
    K = camera.K * np.array([[scale], [scale], [1.0]], np.float32)
    K[0, 2] += 0.5 * (width - scale * camera.width)
    K[1, 2] += 0.5 * (height - scale * camera.height)
    return Camera(K, camera.viewmat, width, height)


def zoom_for_all(shown: Callable[[float], Bool[np.ndarray, "h w"]]) -> float:
    """The largest magnification, of 1 and less, at which a head reaches neither the top nor a side of the picture.

    A filmed frame may cut off the crown of a head, which the avatar has. A neck may end at the bottom. What fills any
    picture keeps 1. `shown` returns where anything is drawn, at a magnification.
    """
    for zoom in _ZOOMS:
        mask = shown(zoom)
        if not (mask[0].any() or mask[:, 0].any() or mask[:, -1].any()):
            return zoom
    return 1.0


def zoom_at_rest(avatar: Avatar, size: tuple[int, int]) -> float:
    """The magnification of pictures of a width and height: 1, or less if that cuts off the person at rest."""
    width, height = (max(8, round(_GLANCE * side / max(size))) for side in size)
    gaussians = avatar.pose()
    return zoom_for_all(lambda zoom: avatar.render(gaussians, fitted(avatar.camera, width, height, zoom))[1] > _FAINT)


def orbit(camera: Camera, center: Float[np.ndarray, " 3"], angle: float, up: Sequence[float] = _UP) -> Camera:
    """`camera` moved around `center` by `angle` radians, counter-clockwise seen from above."""
    axis = np.asarray(up, np.float64)
    turn = matrix_from_axis_angle((angle * axis / np.linalg.norm(axis))[None])[0]
    # p -> turn (p - centre) + centre moves the camera; the world moves the other way.
    back = np.eye(4)
    back[:3, :3] = turn.T
    back[:3, 3] = center - turn.T @ center
    return replace(camera, viewmat=(camera.viewmat.astype(np.float64) @ back).astype(np.float32))


def turned(camera: Camera, center: Float[np.ndarray, " 3"], yaw: float, pitch: float) -> Camera:
    """`camera` moved around `center`: first up by `pitch`, then to the subject's left by `yaw`, both in radians."""
    raised = orbit(camera, center, -pitch, camera.viewmat[0, :3].tolist()) if pitch else camera
    return orbit(raised, center, yaw) if yaw else raised


def turntable(frames: int, span: float) -> list[tuple[float, float]]:
    """Yaws and pitches (`turned`) of a turn around a head, in radians. The first is 0, and the path loops.

    If `span` is below a full turn, the camera swings instead, as a pendulum does: to span / 2 on the subject's left,
    back through the middle to the right, and home.
    """
    phases = [2 * math.pi * index / frames for index in range(frames)]
    full = span >= 2 * math.pi
    return [(phase if full else 0.5 * span * math.sin(phase), 0.0) for phase in phases]


def sway(frames: int, span: float, tilt: float, crossing: bool = True) -> list[tuple[float, float]]:
    """Yaws and pitches of a horizontal figure eight, or of an oval without `crossing`, in radians. The path loops.

    `span` is the angle from the far left to the far right, `tilt` that from the highest to the lowest point.
    """
    phases = [2 * math.pi * index / frames for index in range(frames)]
    raised = [math.sin(2 * phase) if crossing else math.cos(phase) for phase in phases]
    return [(0.5 * span * math.sin(phase), 0.5 * tilt * up) for phase, up in zip(phases, raised, strict=True)]
