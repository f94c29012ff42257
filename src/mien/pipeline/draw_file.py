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
from mien.runtime.filmed import with_filmed_blinks


def render_file(
    source: Path,
    output: Output,
    options: PictureOptions,
    assignments: Sequence[str],
    yaw: float,
    pitch: float,
    zoom: float | None,
    path: Callable[[runtime.Camera, np.ndarray], Sequence[runtime.Camera]],
    fps: float,
) -> None:
    """Draw the avatar in a file along a camera path.

    The avatar's camera is turned by `yaw` and `pitch`, in degrees, and magnified by `zoom` (None: 1, or less if that
    cuts the head off). `path` makes the cameras of it, and of the head's centre in world space, in metres.
    """
    avatar = runtime.load(source)
    portable, rest = avatar.portable, avatar.portable.neutral
    bounds, model = portable.expression_bounds.tolist(), portable.about.face_model
    shut = with_filmed_blinks(portable.expression_bounds, avatar.expression_names, portable.filmed)
    settable = Settable(avatar.expression_names, bounds, avatar.joint_names, model, presets=shut.tolist())
    gaussians = avatar.pose(*assign(assignments, settable, rest.expression, rest.joints))
    center = rest.head_translation.astype(np.float64)
    camera = fitted(avatar.camera, *options.shape(), zoom_at_rest(avatar, options.shape()) if zoom is None else zoom)
    cameras = path(turned(camera, center, math.radians(yaw), math.radians(pitch)), center)

    def picture(camera: runtime.Camera) -> UInt8[np.ndarray, "h w _"]:
        image, alpha = runtime.render(gaussians, camera, options.color())
        return to_rgba(image, alpha) if options.background == "transparent" else to_rgb(image)

    pictures: Iterable[np.ndarray] = map(picture, cameras)
    if output.kind != "still":
        pictures = track_progress(pictures, "Rendering", len(cameras))
    _write(output, pictures, fps)
    wide, high = options.shape()
    say(f"{output.path}: {len(gaussians):,} Gaussians at {wide}x{high}, frames: {len(cameras)}")


def _write(output: Output, pictures: Iterable[np.ndarray], fps: float) -> None:
    if output.kind not in ("still", "sequence"):
        from mien.media.writing import write_pictures

        write_pictures(output, pictures, fps)
        return
    for index, picture in enumerate(pictures):
        path, data = output.path if output.kind == "still" else output.numbered(index), png_bytes(picture)
        write_atomically(path, lambda aside, data=data: aside.write_bytes(data))
