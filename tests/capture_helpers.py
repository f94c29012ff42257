"""Make tiny captures and clips for the tests of mien.capture."""

from pathlib import Path

import av
import cv2
import numpy as np

from mien.capture import Capture
from mien.capture.video import write_video


def random_capture(timesteps: int = 3, cameras: int = 2, height: int = 20, width: int = 31, seed: int = 0) -> Capture:
    """Return a capture of noise, which a PNG must keep exactly."""
    random = np.random.default_rng(seed)
    landmarks = random.uniform(0, 20, (timesteps, cameras, 478, 2)).astype(np.float32)
    valid = np.ones((timesteps, cameras), bool)
    valid[1, 0] = False
    landmarks[1, 0] = np.nan
    return Capture(
        name="noise",
        camera_ids=tuple(f"camera{index}" for index in range(cameras)),
        fps=29.97,
        timestamps=np.arange(timesteps) / 29.97,
        images=random.integers(0, 256, (timesteps, cameras, height, width, 3), dtype=np.uint8),
        mattes=random.integers(0, 256, (timesteps, cameras, height, width), dtype=np.uint8),
        landmarks=landmarks,
        valid=valid,
        principal_point=np.full((cameras, 2), 10.5),
        source={"recipe": "noise", "seed": seed},
    )


def assert_same_capture(one: Capture, other: Capture) -> None:
    assert (one.name, one.camera_ids, one.fps, one.source) == (other.name, other.camera_ids, other.fps, other.source)
    for field in ("timestamps", "images", "mattes", "landmarks", "valid", "principal_point"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)


def tree_bytes(folder: Path) -> dict[str, bytes]:
    """Return the content of every file, except for the cache's stamp, which holds times of change."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "stamp.json")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def scan_texture(test_data: Path) -> np.ndarray:
    """Return the photo texture of the Lee Perry-Smith scan: a flat, frontal face that the detectors find."""
    path = test_data / "leeperrysmith" / "Map-COL.jpg"
    texture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert texture is not None
    return texture


def write_gradient_video(
    path: Path, frames: int = 5, width: int = 64, height: int = 48, fps: float = 25.0
) -> np.ndarray:
    """Write a clip without any person, and return its frames."""
    y, x = np.mgrid[:height, :width]
    pictures = np.stack(
        [np.stack([x * 255 // width, y * 255 // height, (x * 0 + 8 * t) % 256], axis=-1) for t in range(frames)]
    ).astype(np.uint8)
    write_video(path, iter(pictures), fps, crf=1)
    return pictures


def write_face_clip(path: Path, test_data: Path, frames: int = 12, size: tuple[int, int] = (640, 360)) -> np.ndarray:
    """Write a clip of the scan's texture on a plain picture. Return the texture's centre in each frame, in pixels."""
    width, height = size
    face = cv2.resize(scan_texture(test_data), (240, 240), interpolation=cv2.INTER_AREA)
    lefts = 60 + 4 * np.arange(frames)
    pictures = np.full((frames, height, width, 3), 190, np.uint8)
    for picture, left in zip(pictures, lefts, strict=True):
        picture[40:280, left : left + 240] = face
    write_video(path, iter(pictures), 25.0, crf=12)
    return np.stack([lefts + 120, np.full(frames, 160)], axis=-1)


def write_planes(
    path: Path,
    pictures: list[np.ndarray],
    pixel_format: str,
    colors: tuple[int, int, int, int] = (1, 1, 1, 1),
    ticks: list[int] | None = None,
) -> None:
    """Write a lossless clip (FFV1 in Matroska, 25 frames a second) of exactly these Y'CbCr planes [3, h, w], 4:4:4.

    Args:
        path: Path of the clip; it ends in .mkv.
        pictures: Planes as uint8 or uint16, depending on the pixel format.
        pixel_format: FFmpeg's name of the pixel format, such as yuv444p10le.
        colors: Codes of matrix, primaries, transfer and range.
        ticks: Times in milliseconds; by default the rate is even.
    """
    _, height, width = pictures[0].shape
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25 if ticks is None else 1000)
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc, context.color_range = colors
        for index, planes in enumerate(pictures):
            frame = av.VideoFrame(width, height, pixel_format)
            frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range = colors
            frame.pts = index if ticks is None else ticks[index]
            for plane, values in zip(frame.planes, planes, strict=True):
                padded = np.zeros((height, plane.line_size // values.itemsize), values.dtype)
                padded[:, :width] = values
                plane.update(padded.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def to_planes(signal: np.ndarray, weights: tuple[float, float], bits: int) -> np.ndarray:
    """Convert R'G'B' in 0..1 [h, w, 3] to Y'CbCr planes of studio range. `weights` are red's and blue's in luma."""
    red, green, blue = np.moveaxis(signal, -1, 0)
    luma = weights[0] * red + (1 - sum(weights)) * green + weights[1] * blue
    chroma = [(blue - luma) / (2 - 2 * weights[1]), (red - luma) / (2 - 2 * weights[0])]
    unit = 1 << (bits - 8)
    planes = [16 * unit + 219 * unit * luma, *(128 * unit + 224 * unit * value for value in chroma)]
    return np.rint(planes).astype(np.uint16 if bits > 8 else np.uint8)


def face_picture(test_data: Path, side: int = 160, margin: int = 0) -> np.ndarray:
    """Return the scan's texture with a plain margin around it."""
    face = cv2.resize(scan_texture(test_data), (side, side), interpolation=cv2.INTER_AREA)
    return np.pad(face, ((margin, margin), (margin, margin), (0, 0)), constant_values=190)
