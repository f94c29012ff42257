"""The avatar alive: a film of five seconds in which it looks around, blinks and smiles, and a strip of its faces."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from mien import runtime
from mien.avatar import Avatar, make_portable
from mien.camera import Camera
from mien.capture.video import write_video
from mien.errors import UserError
from mien.progress import track_progress
from mien.runtime.rotation import axis_angle_from_matrix, matrix_from_axis_angle
from mien.training.whole_head import with_soft_cut

FILM = "film.mp4"
"""Name of the film in a run's folder."""
SECONDS, FPS, SIDE = 5.0, 25, 512
"""Length in seconds, frames per second, and sides in pixels of the film."""
_MOST_YAW, _MOST_PITCH = 0.4, 0.08
"""Largest turns of the head, in radians. Cameras in front film this much of most heads."""
_FACES = (("smile", 0.9, 1.3, 1.0), ("surprise", 2.6, 0.9, 0.8), ("smile", 3.9, 1.0, 0.6))
"""What the face does: a preset, when it begins and how long it lasts in seconds, and how strong it is."""
_BLINKS = (0.45, 2.35, 3.75)
"""When the eyes are closed, in seconds."""
_BLINK = 0.12
"""Time in which they close, and in which they open, in seconds."""
_STRIP = 6
"""Number of faces in the strip."""


def living(avatar: Avatar, camera: Camera, name: str) -> runtime.Avatar | None:
    """Return the avatar as films and strips draw it, with a soft cut at the neck.

    None if its method has no record without torch.
    """
    try:
        return runtime.Avatar(with_soft_cut(make_portable(avatar, camera, name, to_share=False), avatar))
    except UserError:
        return None


def write_film(path: Path, avatar: runtime.Avatar) -> None:
    """Write the film: 512x512, five seconds, over white. Its end leads to its begin.

    Raises:
        UserError: the file cannot be written.
    """
    write_video(path, _pictures(avatar), FPS)


def strip(avatar: runtime.Avatar) -> list[tuple[str, UInt8[np.ndarray, "h w 3"]]]:
    """Return a few preset faces with their names. Face models without them have none."""
    camera = avatar.camera.square(SIDE)
    names = runtime.presets_for(avatar.expression_names, avatar.joint_names)[:_STRIP]
    return [(name, to_bytes(avatar.render(avatar.pose({name: 1.0}), camera)[0])) for name in names]


def to_bytes(image: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of the runtime, 0..1, as bytes, clamped and rounded."""
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)


def _pictures(avatar: runtime.Avatar) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    camera, rest = avatar.camera.square(SIDE), matrix_from_axis_angle(avatar.portable.neutral.head_rotation)
    shown = runtime.presets_for(avatar.expression_names, avatar.joint_names)
    count = round(SECONDS * FPS)
    for index in track_progress(range(count), "film", count):
        seconds = index / FPS
        phase = 2 * np.pi * seconds / SECONDS
        turn = np.array([_MOST_PITCH * np.sin(2 * phase), _MOST_YAW * np.sin(phase), 0.0])
        rotation = axis_angle_from_matrix(rest @ matrix_from_axis_angle(turn))
        faces = {name: value for name, value in _face(seconds).items() if name in shown}
        yield to_bytes(avatar.render(avatar.pose(faces, head_rotation=rotation), camera)[0])


def _face(seconds: float) -> dict[str, float]:
    """Preset faces and their strengths at a time. Closed eyes come last, because they hold of several."""
    faces: dict[str, float] = {}
    for name, begin, lasts, strength in _FACES:
        share = np.clip((seconds - begin) / lasts, 0, 1)
        if 0 < share < 1:
            faces[name] = strength * float(np.sin(np.pi * share)) ** 0.7
    closed = max(max(0.0, 1 - abs(seconds - blink) / _BLINK) for blink in _BLINKS)
    return faces | ({"closed_eyes": closed} if closed else {})
