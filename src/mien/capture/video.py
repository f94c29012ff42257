"""Video files in and out, one frame at a time (PyAV; no system ffmpeg)."""

import itertools
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import UInt8

from mien.errors import UserError
from mien.progress import say
from mien.storage import write_atomically

_THREADS = 2
_ACCURATE = Interpolation.BICUBIC | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Without accurate rounding swscale is five times faster, but darkens pictures by a whole level."""
_SHRINKING = Interpolation.AREA | Interpolation.ACCURATE_RND
_UNSPECIFIED_COLORSPACE = 2
_HIGH_DEFINITION_HEIGHT = 720
_DEFAULT_FPS = 25.0


@dataclass(frozen=True)
class VideoInfo:
    """What a video file says about itself; only decoding tells the truth."""

    fps: float
    """Average frames a second."""
    frames: int
    """How many frames to expect; 0 where the file does not say."""


def probe_video(path: Path) -> VideoInfo:
    """The frame rate and the expected number of frames.

    Raises:
        UserError: the file is missing or is no video.
    """
    with _open_video(path) as (container, stream):
        fps = float(stream.average_rate or stream.guessed_rate or _DEFAULT_FPS)
        if stream.duration is not None and stream.time_base is not None:
            seconds = float(stream.duration * stream.time_base)
        else:
            seconds = (container.duration or 0) / av.time_base
        return VideoInfo(fps, stream.frames or round(seconds * fps))


def read_video_frames(path: Path, longest_side: int = 0) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    """Every frame in the order of display: its time in seconds from the first frame, and its sRGB picture.

    The file's rotation and mirror flags are applied. Damaged parts are skipped with a warning.

    Args:
        path: of the video.
        longest_side: shrink larger pictures to this many pixels, area-averaged; 0 keeps the size.

    Raises:
        UserError: the file is missing, is no video, or no frame of it can be decoded.
    """
    with _open_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = _THREADS
        interval = 1.0 / float(stream.average_rate or stream.guessed_rate or _DEFAULT_FPS)
        first: float | None = None
        latest = -interval
        reformatter = VideoReformatter()
        for frame in _decode(path, container, stream):
            if frame.pts is None or frame.time_base is None:
                seconds = latest + interval
            else:
                absolute = float(frame.pts * frame.time_base)
                first = absolute if first is None else first
                seconds = absolute - first
            # Times must increase for everything that differentiates over time; broken files repeat them.
            latest = seconds if seconds > latest else latest + interval
            yield latest, _to_rgb(frame, reformatter, longest_side)


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], fps: int | float, crf: int = 18) -> None:
    """Write sRGB frames as H.264 (yuv420p, BT.709), atomically; odd sizes get a repeated last row or column.

    Args:
        path: usually ends in .mp4; the ending chooses the container.
        frames: all of one size; may be a generator, is read once.
        fps: frames a second.
        crf: x264's constant rate factor: 0 is lossless, 18 looks so, 51 is worst.

    Raises:
        UserError: `frames` is empty, or the file cannot be written.
    """
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise UserError(f"{path}: no frames to write; check the selection of frames")
    try:
        write_atomically(path, lambda aside: _encode(aside, itertools.chain([first], iterator), first.shape, fps, crf))
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from None


def _encode(path: Path, frames: Iterable[np.ndarray], shape: tuple[int, ...], fps: int | float, crf: int) -> None:
    height, width = shape[:2]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options={"crf": str(crf)})
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        context = stream.codec_context
        context.thread_count = _THREADS
        # BT.709 for matrix, primaries and transfer, studio range: what players assume, and written down.
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = ColorRange.MPEG
        reformatter = VideoReformatter()
        for image in frames:
            assert image.shape == shape, f"frames of {shape}, then one of {image.shape}"
            assert image.dtype == np.uint8, image.dtype
            even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            frame = reformatter.reformat(
                av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24"),
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                interpolation=_ACCURATE,
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@contextmanager
def _open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    if not path.exists():
        raise UserError(f"{path}: no such file; check the path")
    if not path.is_file():
        raise UserError(f"{path}: is no file; name a video file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: is empty; copy or record it again")
    try:
        container = av.open(str(path), "r")
    except (av.error.FFmpegError, OSError) as error:
        raise UserError(
            f"{path}: cannot be read as a video ({error.strerror or error}); give a video file, such as .mp4 or .mov"
        ) from None
    with container:
        if not container.streams.video:
            raise UserError(f"{path}: has no video stream; give a file with pictures in it")
        yield container, container.streams.video[0]


def _decode(path: Path, container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """All frames; what cannot be decoded is skipped, counted, and reported at the end."""
    damaged, decoded = 0, 0
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            damaged += 1
            break
        if packet is None:
            break
        try:
            frames = packet.decode()
        except av.error.FFmpegError:
            damaged += 1
            continue
        for frame in frames:
            decoded += 1
            yield frame
    if decoded == 0:
        raise UserError(f"{path}: no frame of the video can be decoded; convert it to H.264 or record it again")
    if damaged:
        say(f"warning: {path}: {damaged} damaged parts of the video were skipped")


def _to_rgb(frame: av.VideoFrame, reformatter: VideoReformatter, longest_side: int) -> UInt8[np.ndarray, "h w 3"]:
    colorspace = frame.colorspace
    if colorspace == _UNSPECIFIED_COLORSPACE:
        # Files that do not say follow the custom of players: BT.709 from 720 lines up, BT.601 below.
        colorspace = Colorspace.ITU709 if frame.height >= _HIGH_DEFINITION_HEIGHT else Colorspace.ITU601
    scale = min(1.0, longest_side / max(frame.width, frame.height)) if longest_side else 1.0
    converted = reformatter.reformat(
        frame,
        width=max(1, round(frame.width * scale)),
        height=max(1, round(frame.height * scale)),
        format="rgb24",
        src_colorspace=colorspace,
        interpolation=_ACCURATE if scale == 1.0 else _SHRINKING,
    )
    return _apply_display_matrix(converted.to_ndarray(), frame)


def _apply_display_matrix(image: np.ndarray, frame: av.VideoFrame) -> np.ndarray:
    """Rotate and mirror by the display matrix: x' = a x + c y, y' = b x + d y with entries of -1, 0, 1."""
    side_data: Any = frame.side_data  # PyAV's stub types its keys as strings
    data = side_data.get(SideDataType.DISPLAYMATRIX)
    if data is None:
        return image
    a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].tolist()
    if abs(b) > abs(a):
        image = image.swapaxes(0, 1)
        flip_x, flip_y = c < 0, b < 0
    else:
        flip_x, flip_y = a < 0, d < 0
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])
