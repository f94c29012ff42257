"""Screenshots and videos of a session, as the content of files."""

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from mien.media.output import Output
from mien.media.pixels import png_bytes
from mien.runtime.rotation import matrix_from_axis_angle
from mien.viewer.drawing import MAX_SIDE, View
from mien.viewer.session import Session

TURNTABLE_FRAMES = 100
"""Number of frames of a turntable, which is the video of a session without a motion."""
SCREENSHOT_HEIGHT = 1080
"""Smallest height of a screenshot in pixels."""


class Stopped(Exception):  # noqa: N818
    """The recording was stopped."""


def screenshot(session: Session, view: View) -> bytes:
    """A view as the content of a .png, in the shape of the browser's canvas, with at least as many pixels.

    The height is at least `SCREENSHOT_HEIGHT`, because a browser that draws slowly makes its canvas smaller than its
    window.
    """
    scale = max(1.0, SCREENSHOT_HEIGHT / max(1, view.height))
    larger = replace(view, width=round(scale * view.width), height=round(scale * view.height))
    return png_bytes(session.picture(larger, height=MAX_SIDE))


def video(
    session: Session, view: View, center: Float[np.ndarray, " 3"], go_on: Callable[[], bool] = lambda: True
) -> bytes:
    """The content of an .mp4: the whole motion of the session, or a turntable of its face, from a view.

    A turntable goes around `center`, in world space, in metres. `Stopped` is raised when `go_on` returns False.
    """
    from mien.media.writing import write_pictures

    clip = session.clip

    def pictures() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for index in range(TURNTABLE_FRAMES if clip is None else len(clip.motion)):
            if not go_on():
                raise Stopped
            if clip is None:
                yield session.picture(around(view, center, 2 * math.pi * index / TURNTABLE_FRAMES))
            else:
                yield session.picture(view, timestep=index)

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        write_pictures(Output(path, "mp4", False), pictures(), 25.0 if clip is None else clip.motion.fps)
        return path.read_bytes()


def around(view: View, center: Float[np.ndarray, " 3"], angle: float) -> View:
    """The view from a camera that went around a point, about its own vertical axis, by an angle in radians."""
    up = view.viewmat[1, :3].astype(np.float64)
    turn = matrix_from_axis_angle((angle * up)[None])[0]
    moved = view.viewmat.astype(np.float64).copy()
    moved[:3, 3] += moved[:3, :3] @ (center - turn @ center)
    moved[:3, :3] = moved[:3, :3] @ turn
    return replace(view, viewmat=moved)
