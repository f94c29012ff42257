"""The NeRSemble benchmark's layout: calibrated videos, mattes, and for one camera a tracking on FLAME 2023.

Videos are lossless (H.264 of RGB), so that a round trip keeps every pixel. Held-out frames are a sequence of their own,
and cameras that are held out are missing, as in the benchmark.
"""

import io
import itertools
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from mien.datasets.layouts.filmed import Filmed, as_flame, lost_words
from mien.datasets.layouts.layout import Written
from mien.datasets.layouts.writing import write_plain_json
from mien.datasets.nersemble import CALIBRATION
from mien.datasets.nersemble_benchmark import TEST_ENDING, TRACKING
from mien.machine.progress import say
from mien.media.video_file import create_video

_SHAPES, _EXPRESSIONS = 300, 100
_POSES = ("neck_pose", "jaw_pose", "eyes_pose")


def write(folder: Path, filmed: Filmed) -> Written:
    """Write the files of a person of the benchmark."""
    capture = filmed.sequence.capture
    cameras = dict(zip(capture.camera_ids, filmed.sequence.tracking.cameras, strict=True))
    write_plain_json(
        folder / CALIBRATION,
        {
            "world_2_cam": {name: camera.viewmat.double().tolist() for name, camera in cameras.items()},
            "intrinsics": {name: camera.K.double().tolist() for name, camera in cameras.items()},
            "image_size": list(filmed.size),
        },
    )
    names: dict[tuple[int, int], str] = {}
    parts = {capture.name: filmed.trained, f"{capture.name}{TEST_ENDING}": filmed.held_out}
    for part, timesteps in parts.items():
        place = folder / "sequences" / part
        for index, camera in enumerate(capture.camera_ids):
            names |= {(t, index): f"{part}_cam_{camera}_{number:05d}" for number, t in enumerate(timesteps)}
            if timesteps and index not in filmed.hidden:
                say(f"write {part}, camera {camera}")
                images = (filmed.image(timestep, index) for timestep in timesteps)
                mattes = (np.repeat(filmed.matte(timestep, index)[..., None], 3, axis=2) for timestep in timesteps)
                _write_video(place / "images" / f"cam_{camera}.mp4", images, capture.fps)
                _write_video(place / "alpha_maps" / f"cam_{camera}.mp4", mattes, capture.fps)
    told = [
        f"sequences/{capture.name} is trained on; sequences/{capture.name}{TEST_ENDING} is held out.",
        "Videos are lossless H.264 of RGB (libx264rgb); their time begins at 0 and has no gaps.",
        "Not written: pointclouds and colour calibration.",
    ]
    if filmed.hidden:
        hidden = ", ".join(capture.camera_ids[index] for index in filmed.hidden)
        told.append(f"Held-out cameras: {hidden}. They are in the calibration, and have no videos.")
    return Written(names, (*told, *_track(folder, filmed, parts)))


def _track(folder: Path, filmed: Filmed, parts: dict[str, tuple[int, ...]]) -> tuple[str, ...]:
    """Write the tracking, if the layout has a place for it, and return what is said of it."""
    if len(filmed.sequence.capture.camera_ids) > 1:
        return ("tracking: not written, because the benchmark has none for several cameras.",)
    if filmed.face_model.flame_origin is None:
        return (f"tracking: not written, because {filmed.face_model.name} is not FLAME.",)
    arrays, told = _flame(folder, filmed)
    rows = {timestep: index for index, timestep in enumerate(filmed.timesteps)}
    for part, timesteps in parts.items():
        if not timesteps:
            continue
        picked = [rows[timestep] for timestep in timesteps]
        own = {name: array if name in ("shape", "scale") else array[picked] for name, array in arrays.items()}
        file = folder / "sequences" / part / "tracking" / TRACKING
        file.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        whole = {**{name: array.astype(np.float32) for name, array in own.items()}, "frames": np.arange(len(timesteps))}
        np.savez(content, **whole)  # pyright: ignore
        file.write_bytes(content.getvalue())
    return told


def _flame(folder: Path, filmed: Filmed) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The arrays of a tracking at all written timesteps, in the world of the calibration, and what is lost.

    FLAME's root is at rest, and the whole model is turned about its origin.
    """
    face = filmed.sequence.tracking.face[filmed.timesteps]
    whole, arrays, turns, shifts = as_flame(folder, filmed, face, _POSES, _SHAPES, _EXPRESSIONS)
    told = ["tracking: right for other programs only if the face model is FLAME 2023."]
    if whole["static_offset"].any():
        told.append("Lost: the offsets of the mesh.")
    told += [*lost_words("identity", whole["shape"], _SHAPES), *lost_words("expression", whole["expr"], _EXPRESSIONS)]
    # Angles in radians whose rotations Rx Ry Rz are the turns.
    x, z = np.arctan2(-turns[:, 1, 2], turns[:, 2, 2]), np.arctan2(-turns[:, 0, 1], turns[:, 0, 0])
    angles = np.stack([x, np.arcsin(np.clip(turns[:, 0, 2], -1, 1)), z], axis=1)
    written = {
        "shape": arrays["shape"][None], "expression": arrays["expr"], "rotation": angles,
        "rotation_matrices": turns, "translation": shifts, "scale": np.ones((1, 1)), "jaw": arrays["jaw_pose"],
        "neck": arrays["neck_pose"], "eyes": arrays["eyes_pose"],
    }  # fmt: skip
    return written, tuple(told)


def _write_video(path: Path, pictures: Iterator[UInt8[np.ndarray, "h w 3"]], fps: float) -> None:
    """Write pictures as lossless H.264."""
    path.parent.mkdir(parents=True, exist_ok=True)
    first = next(pictures)
    with create_video(path) as container:
        options = {"crf": "0", "preset": "veryfast"}
        stream = container.add_stream("libx264rgb", rate=Fraction(fps).limit_denominator(1001), options=options)
        stream.width, stream.height, stream.pix_fmt = first.shape[1], first.shape[0], "rgb24"
        stream.codec_context.thread_count = 1
        for picture in itertools.chain([first], pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
