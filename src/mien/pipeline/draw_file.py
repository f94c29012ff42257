"""Pictures of an avatar that comes from a .mien file. They are drawn without torch, and a .png needs no OpenCV."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mien import runtime
from mien.disk.files import write_atomically
from mien.machine.progress import say, track_progress
from mien.media.output import Output
from mien.media.pixels import png_bytes, to_rgb, to_rgba
from mien.pipeline.assignments import Settable, assign
from mien.pipeline.picture_options import PictureOptions
from mien.runtime.camera_paths import fitted, turned, zoom_at_rest

CameraPath = Callable[[runtime.Camera, np.ndarray], Sequence[runtime.Camera]]
"""Returns the cameras of a path, from its first camera and the centre of the head in world space, in metres."""


def render_file(
    source: Path, output: Output, options: PictureOptions, assignments: Sequence[str], view: "View", fps: float
) -> None:
    """Draw the avatar in a file along a camera path."""
    avatar = runtime.load(source)
    portable, rest = avatar.portable, avatar.portable.neutral
    bounds, model = portable.expression_bounds.tolist(), portable.about.face_model
    settable = Settable(avatar.expression_names, bounds, avatar.joint_names, model)
    gaussians = avatar.pose(*assign(assignments, settable, rest.expression, rest.joints))
    cameras = view.cameras(avatar, options)

    def picture(camera: runtime.Camera) -> UInt8[np.ndarray, "h w _"]:
        image, alpha = runtime.render(gaussians, camera, options.color())
        return to_rgba(image, alpha) if options.background == "transparent" else to_rgb(image)

    pictures: Iterable[np.ndarray] = map(picture, cameras)
    if output.kind != "still":
        pictures = track_progress(pictures, "Rendering", len(cameras))
    _write(output, pictures, fps)
    wide, high = options.shape()
    say(f"{output.path}: {len(gaussians):,} Gaussians at {wide}x{high}, frames: {len(cameras)}")


class View:
    """Place of the camera: how it is moved first, and the path that it then takes."""

    def __init__(self, yaw: float, pitch: float, zoom: float | None, path: CameraPath) -> None:
        """Take angles in degrees, the magnification (None: 1, or less if that cuts the head off), and the path."""
        self._yaw, self._pitch, self._zoom, self._path = math.radians(yaw), math.radians(pitch), zoom, path

    def cameras(self, avatar: runtime.Avatar, options: PictureOptions) -> Sequence[runtime.Camera]:
        """The cameras of all frames."""
        center = avatar.portable.neutral.head_translation.astype(np.float64)
        zoom = zoom_at_rest(avatar, options.shape()) if self._zoom is None else self._zoom
        camera = fitted(avatar.camera, *options.shape(), zoom)
        return self._path(turned(camera, center, self._yaw, self._pitch), center)


def _write(output: Output, pictures: Iterable[np.ndarray], fps: float) -> None:
    if output.kind not in ("still", "sequence"):
        from mien.media.writing import write_pictures

        write_pictures(output, pictures, fps)
        return
    for index, picture in enumerate(pictures):
        path, data = output.path if output.kind == "still" else output.numbered(index), png_bytes(picture)
        write_atomically(path, lambda aside, data=data: aside.write_bytes(data))
