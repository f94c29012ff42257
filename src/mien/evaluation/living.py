"""The avatar alive: a film of five seconds in which it looks around, blinks and smiles, and a strip of its faces."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mien import runtime
from mien.avatar.avatar import Avatar
from mien.avatar.baking import make_portable
from mien.camera import Camera
from mien.errors import UserError
from mien.machine.progress import track_progress
from mien.media.video import write_video
from mien.runtime.camera_paths import fitted, zoom_for_all
from mien.runtime.filmed import head_angles
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.training.footage.coverage import Coverage
from mien.training.footage.filmed import filmed_yaws
from mien.training.whole_head.soft_cut import with_soft_cut

FILM = "film.mp4"
"""Name of the film in a run's folder."""
SECONDS, FPS, SIDE = 5.0, 25, 512
"""Length in seconds, frames per second, and sides in pixels of the film."""
MOST_YAW, LEAST_YAW, _MOST_PITCH = 0.4, 0.1, 0.08
"""Largest turns of the head to a side, turns that every head makes, and largest nods, in radians."""
_MARGIN = 0.06  # width of the free space around the head, as a share of the picture
_FACES = (("smile", 0.9, 1.3, 1.0), ("surprise", 2.6, 0.9, 0.8), ("smile", 3.9, 1.0, 0.6))
"""What the face does: a preset, when it begins and how long it lasts in seconds, and how strong it is."""
_BLINKS = (0.45, 2.35, 3.75)  # when the eyes are closed, in seconds
_BLINK = 0.12  # time in which they close, and in which they open, in seconds
_STRIP = 6  # number of faces in the strip


@dataclass(frozen=True)
class Living:
    """An avatar as films and strips show it."""

    avatar: runtime.Avatar
    camera: runtime.Camera
    """The view of the training, square, and as near as the turning head fits."""
    yaws: tuple[float, float]
    """How far the head turns from its rest, in radians: to its right (below 0), and to its left (above 0)."""


def living(avatar: Avatar, camera: Camera, name: str, coverage: Coverage | None) -> Living | None:
    """Return the avatar as films and strips show it, with a soft cut at the neck.

    Its head turns to a side as far as `coverage` says that this side was filmed, because the rest is a guess, and
    always a little. Without a coverage it turns to both sides alike. None if its method has no record without torch.
    """
    try:
        alive = runtime.Avatar(with_soft_cut(make_portable(avatar, camera, name, to_share=False), avatar))
    except UserError:
        return None
    neutral, reached = avatar.face_model.head_vertices(avatar.subject)[0], None
    if coverage is not None:
        reached = filmed_yaws(avatar.face_model, neutral, coverage) or (0, 0)
    yaws = yaws_of(alive, reached)
    return Living(alive, near_camera(alive, yaws), yaws)


def write_film(path: Path, alive: Living) -> None:
    """Write the film: 512x512, five seconds, over white. Its end leads to its begin."""
    write_video(path, pictures_of(alive), FPS)


def strip(alive: Living) -> list[tuple[str, UInt8[np.ndarray, "h w 3"]]]:
    """Return a few preset faces with their names. Face models without them have none."""
    avatar = alive.avatar
    names = runtime.presets_for(avatar.expression_names, avatar.joint_names)[:_STRIP]
    return [(name, to_bytes(avatar.render(avatar.pose({name: 1.0}), alive.camera)[0])) for name in names]


def to_bytes(image: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of the runtime, 0..1, as bytes, clamped and rounded."""
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)


def pictures_of(alive: Living) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the pictures of the film."""
    avatar, (right, left) = alive.avatar, alive.yaws
    shown = runtime.presets_for(avatar.expression_names, avatar.joint_names)
    count = round(SECONDS * FPS)
    for index in track_progress(range(count), "film", count):
        seconds = index / FPS
        phase = 2 * np.pi * seconds / SECONDS
        yaw = 0.5 * (left + right) + 0.5 * (left - right) * np.sin(phase)
        faces = {name: value for name, value in _face(seconds).items() if name in shown}
        rotation = turned_head(avatar, yaw, _MOST_PITCH * np.sin(2 * phase))
        yield to_bytes(avatar.render(avatar.pose(faces, head_rotation=rotation), alive.camera)[0])


def turned_head(avatar: runtime.Avatar, yaw: float, pitch: float) -> Float32[np.ndarray, " 3"]:
    """The rotation of the head that is turned from its rest, as an axis-angle vector in radians."""
    rest = matrix_from_axis_angle(avatar.portable.neutral.head_rotation)
    return axis_angle_from_matrix(rest @ matrix_from_axis_angle(np.array([pitch, yaw, 0.0]))).astype(np.float32)


def yaws_of(avatar: runtime.Avatar, reached: tuple[int, int] | None) -> tuple[float, float]:
    """`Living.yaws` of a head that was filmed from so many degrees to its right to so many to its left."""
    if reached is None:
        return -MOST_YAW, MOST_YAW
    camera, neutral = avatar.camera, avatar.portable.neutral
    eye = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    # A head that turns to its left shows its right.
    at_rest = float(head_angles(neutral.head_rotation[None], neutral.head_translation[None], eye)[0, 0])
    right, left = np.radians(reached)
    to_left, to_right = np.clip([right + at_rest, left - at_rest], LEAST_YAW, MOST_YAW)
    return -float(to_right), float(to_left)


def near_camera(avatar: runtime.Avatar, yaws: tuple[float, float]) -> runtime.Camera:
    """`Living.camera`. It shows no more than the view of the training, unless that cuts the head off."""
    square = avatar.camera.square(SIDE)
    turned = [
        avatar.pose(head_rotation=turned_head(avatar, yaw, pitch))
        for yaw in (*yaws, 0.0)
        for pitch in (-_MOST_PITCH, _MOST_PITCH)
    ]

    def drawn(zoom: float) -> Bool[np.ndarray, "h w"]:
        return np.any([avatar.render(one, fitted(square, SIDE, SIDE, zoom))[1] > 0.1 for one in turned], axis=0)

    zoom = zoom_for_all(drawn)
    camera, shown = fitted(square, SIDE, SIDE, zoom), drawn(zoom)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    if not len(rows):
        return camera
    ends = np.array([[columns[0], columns[-1] + 1], [rows[0], rows[-1] + 1]])
    scale = max(1.0, (1 - 2 * _MARGIN) * SIDE / float((ends[:, 1] - ends[:, 0]).max()))
    K = camera.K * np.array([[scale], [scale], [1.0]], np.float32)
    K[:2, 2] += SIDE / 2 - scale * ends.mean(1).astype(np.float32)
    return replace(camera, K=K)


def _face(seconds: float) -> dict[str, float]:
    """Preset faces and their strengths at a time. Closed eyes come last, because they hold of several."""
    faces: dict[str, float] = {}
    for name, begin, lasts, strength in _FACES:
        share = np.clip((seconds - begin) / lasts, 0, 1)
        if 0 < share < 1:
            faces[name] = strength * float(np.sin(np.pi * share)) ** 0.7
    closed = max(max(0.0, 1 - abs(seconds - blink) / _BLINK) for blink in _BLINKS)
    return faces | ({"closed_eyes": closed} if closed else {})
