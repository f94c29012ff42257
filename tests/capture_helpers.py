"""Make tiny captures and clips for the tests of mien.capture."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from color_charts import to_light
from mien.capture.capture import Capture
from mien.media.colors import PQ, hlg_scene_light, pq_light
from mien.media.video import write_video

BT2020, BT709 = (0.2627, 0.0593), (0.2126, 0.0722)
"""Weights of red and blue in luma."""


def random_capture(timesteps: int = 3, cameras: int = 2, height: int = 20, width: int = 31, seed: int = 0) -> Capture:
    """Return a capture of noise, which a PNG must keep exactly."""
    random = np.random.default_rng(seed)
    landmarks = random.uniform(0, 20, (timesteps, cameras, 478, 2)).astype(np.float32)
    valid = np.ones((timesteps, cameras), bool)
    valid[1, 0] = False
    landmarks[1, 0] = np.nan
    return Capture(
        name="noise", camera_ids=tuple(f"camera{index}" for index in range(cameras)), fps=29.97,
        timestamps=np.arange(timesteps) / 29.97,
        images=random.integers(0, 256, (timesteps, cameras, height, width, 3), dtype=np.uint8),
        mattes=random.integers(0, 256, (timesteps, cameras, height, width), dtype=np.uint8), landmarks=landmarks,
        valid=valid, principal_point=np.full((cameras, 2), 10.5), source={"recipe": "noise", "seed": seed},
    )  # fmt: skip


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
    texture = cv2.imread(str(test_data / "leeperrysmith" / "Map-COL.jpg"), cv2.IMREAD_COLOR_RGB)
    assert texture is not None
    return texture


def write_gradient_video(path: Path, frames: int = 5, width: int = 64, height: int = 48, fps: float = 25.0):
    """Write a clip without any person, and return its frames."""
    y, x = np.mgrid[:height, :width]
    channels = [(x * 255 // width, y * 255 // height, (x * 0 + 8 * t) % 256) for t in range(frames)]
    pictures = np.moveaxis(np.array(channels, np.uint8), 1, -1)
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


Codes = tuple[int, int, int, int]
"""Codes of matrix, primaries, transfer and range."""


def encode(
    path: Path, frames: Sequence[np.ndarray | list[np.ndarray] | av.VideoFrame], codec: str = "libx264",
    pixels: str = "yuv420p", *, rate: int = 25, options: dict[str, str] | None = None, colors: Codes | None = None,
    tags: Codes | None = None, ticks: Sequence[int] | None = None,
    prepare: Callable[[Any], object] = lambda stream: None,
) -> None:  # fmt: skip
    """Encode a video with FFmpeg, whose names of codecs and pixel formats are given.
    Frames are RGB pictures [h, w, 3], lists of planes of the pixel format, or as PyAV has them. `ticks` are their times
    in units of the rate. `colors` are stated by the codec's header and the frames, `tags` by the container. Without
    options, libx264 keeps nearly every level. `prepare` changes the stream before anything is encoded."""
    given = [_frame_of(frame, pixels) for frame in frames]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or ({"crf": "1"} if codec == "libx264" else {}))
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = given[0].width, given[0].height, pixels
        prepare(stream)
        packets = []
        for target in (stream.codec_context, *given) if colors else ():
            _state(target, colors)
        for frame, tick in zip(given, ticks or range(len(given)), strict=True):
            frame.pts = tick
            packets += stream.encode(frame)
        packets += stream.encode()
        if tags:
            # The muxer takes the tags of this moment, which the encoder no longer reads.
            _state(stream.codec_context, tags)
        container.mux(packets)


def _state(target: Any, colors: Codes | None) -> None:
    if colors:
        target.colorspace, target.color_primaries, target.color_trc, target.color_range = colors


def _frame_of(given: np.ndarray | list[np.ndarray] | av.VideoFrame, pixels: str) -> av.VideoFrame:
    if isinstance(given, av.VideoFrame):
        return given
    if isinstance(given, np.ndarray):
        return av.VideoFrame.from_ndarray(np.ascontiguousarray(given), format="rgb24")
    frame = av.VideoFrame(given[0].shape[1], given[0].shape[0], pixels)
    for plane, values in zip(frame.planes, given, strict=True):
        padded = np.zeros((plane.height, plane.line_size // values.itemsize), values.dtype)
        padded[:, : values.shape[1]] = values
        plane.update(padded.tobytes())
    return frame


def write_planes(path: Path, pictures: list[np.ndarray], pixels: str, colors: Codes = (1, 1, 1, 1), ticks=None) -> None:
    """Write a lossless .mkv (FFV1) of these Y'CbCr planes [3, h, w], 4:4:4, at 25 frames a second or at ticks in ms."""
    encode(path, list(map(list, pictures)), "ffv1", pixels, rate=1000 if ticks else 25, colors=colors, ticks=ticks)


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


def _inverse(curve: Callable[[np.ndarray], np.ndarray], values: np.ndarray) -> np.ndarray:
    signal = np.linspace(0, 1, 200001)
    return np.interp(values, curve(signal), signal)


def light_of(srgb: np.ndarray) -> np.ndarray:
    """Return linear light, 0..1, of sRGB levels, 0..255."""
    return to_light(srgb / 255)


def hdr_signal(light: np.ndarray, transfer: int) -> np.ndarray:
    """Return the BT.2020 signal of sRGB's display light, where 1 is 203 cd/m2."""
    matrix = [[0.627404, 0.329283, 0.043313], [0.069097, 0.919540, 0.011362], [0.016391, 0.088013, 0.895595]]
    display = 203 * light @ np.array(matrix).T  # BT.2087
    if transfer == PQ:
        return _inverse(pq_light, display)
    luminance = display @ np.array([0.2627, 0.6780, 0.0593])
    scene = display / 1000 * np.power(np.maximum(luminance / 1000, 1e-9), 1 / 1.2 - 1)[..., None]
    return _inverse(hlg_scene_light, scene)


def write_rig(path: Path, *cameras: dict[str, Any], **others: object) -> Path:
    """Write a calibration of these cameras."""
    path.write_text(json.dumps({"format": "mien.cameras", "version": 1, "cameras": cameras, **others}))
    return path


def interrupt_at(count: int, monkeypatch: pytest.MonkeyPatch, place: object, name: str) -> list[tuple[Any, ...]]:
    """Let the call number `count` of a function end by Ctrl-C. Return a list that gets the arguments of each call."""
    original, calls = getattr(place, name), []

    def interrupted(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        if len(calls) == count:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(place, name, interrupted)
    return calls
