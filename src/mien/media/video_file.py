"""Step 1: open video files, and create them. No other module does.

FFmpeg does not treat every name as a file: `take:1.mp4` is an address to it, `%03d.png` is a series of files, and a
playlist makes it open the files in the list. So it never gets a name here. It reads and writes a file that Python has
opened, may open nothing else, and accepts only containers that hold their own pictures.
"""

import contextlib
import itertools
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

import av
import av.error
from av.audio.stream import AudioStream
from av.container import InputContainer, OutputContainer
from av.stream import Disposition
from av.video.stream import VideoStream

from mien.errors import UserError
from mien.media.colors import Colors, stated_colors

MAX_FRAME_PIXELS = 8192 * 4608
"""Largest number of pixels of a video's pictures: 8K of every kind. A decoder holds up to 17 pictures at a time."""
TOO_MANY_PIXELS = f"more than the {MAX_FRAME_PIXELS:,} pixels (8192x4608) that a video may have"
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
_CONTAINERS = (
    "mov", "matroska", "avi", "mpegts", "mpeg", "mpegvideo", "m4v", "flv", "live_flv", "asf", "ogg", "mxf", "gxf",
    "nut", "dv", "gif", "apng", "ivf", "obu", "av1", "h261", "h263", "h264", "hevc", "vvc", "vc1", "dirac", "dnxhd",
    "mjpeg", "yuv4mpegpipe", "wtv", "rm", "swf", "dhav", "cine", "webp_anim", "png_pipe", "jpeg_pipe", "webp_pipe",
    "bmp_pipe", "tiff_pipe", "wav", "mp3", "flac", "aac", "aiff",
)  # fmt: skip
"""FFmpeg's names of the containers that are accepted. None of them refers to other files. Files with only sound are
accepted too, so that the message can say that they have no video."""
_LIST = re.compile(
    rb"\A(\xef\xbb\xbf)?\s*#EXTM3U|\Affconcat version|<MPD[\s>]|<SmoothStreamingMedia|<CompositionPlaylist|<AssetMap"
    rb"|\Av=0\r?\n(?s:.*)\nm=|\A\[InternetShortcut\]|\A\[playlist\]|\A<asx"
)
"""Beginnings of files that name other files or addresses instead of holding pictures."""
_ANY_TITLE: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
"""Titles may have any encoding. PyAV 19 takes them as they are and no longer has the argument."""
_STILLS = Disposition.timed_thumbnails | Disposition.still_image
_AnyStream = TypeVar("_AnyStream", VideoStream, AudioStream)


class _Local:
    """A file as FFmpeg sees it. Its name is a placeholder, whose ending chooses the container when writing."""

    def __init__(self, file: IO[bytes], name: str = "video") -> None:
        self.read, self.write, self.seek, self.tell = file.read, file.write, file.seek, file.tell
        self.name = name
        self.readable, self.writable, self.seekable = file.readable, file.writable, file.seekable


@contextmanager
def open_video(path: Path, wanted: int | None = None) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open a stream of moving pictures, by default the first one of `find_streams`, ready to be decoded."""
    with _open_container(path, "video") as container:
        stream = _moving_pictures(path, container, wanted)
        width, height = stream.codec_context.width, stream.codec_context.height
        if width * height > MAX_FRAME_PIXELS:
            raise UserError(f"{path}: its pictures have {width}x{height} pixels, {TOO_MANY_PIXELS}; make it smaller")
        stream.codec_context.options = {"max_pixels": str(MAX_FRAME_PIXELS)}
        yield container, stream


def find_streams(path: Path) -> list[int]:
    """Return the indices of a file's streams of moving pictures, the one that counts as the video first.

    Covers, thumbnails, streams of one packet and streams of more than 1,000 frames a second come last. Of the others,
    streams that the file marks as default come first, then those with more pixels.
    """
    with _open_container(path, "video") as container:
        return [stream.index for stream in _rank(path, _known_pictures(path, container))]


def read_container_tags(path: Path, index: int) -> tuple[Colors, int]:
    """Return the colours of a stream and the order of its fields (FFmpeg's code) as its container states them.

    FFmpeg replaces them by what the first pictures say as soon as it may decode them, so it may not here.
    """
    with _open_container(path, "video", {"codec_whitelist": "none"}) as container:
        context = _moving_pictures(path, container, index).codec_context
        return stated_colors(context), context.field_order


@contextmanager
def open_sound(path: Path) -> Iterator[tuple[InputContainer, AudioStream]]:
    """Open a file and its stream of sound, chosen by the rule of `find_streams`, ready to be decoded."""
    with _open_container(path, "sound") as container:
        streams = [stream for stream in container.streams.audio if stream.codec_context is not None]
        if not streams:
            raise UserError(f"{path}: has no sound; give a file with sound in it, such as a .wav")
        yield container, _rank(path, streams)[0]


@contextmanager
def _open_container(path: Path, kind: str, also: dict[str, str] | None = None) -> Iterator[InputContainer]:
    """Open a file. `also` is further options of the container."""
    if not path.exists():
        raise UserError(f"{path}: no such file; check the path")
    if not path.is_file():
        raise UserError(f"{path}: is not a file; give a {kind} file")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: is empty; copy or record it again")
    try:
        file = path.open("rb")
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    with file:
        try:
            container = av.open(
                _Local(file),
                "r",
                # FFmpeg does not report a size that it refuses. Somewhat larger sizes are let through here, so that the
                # message can name them.
                options={"max_pixels": str(4 * MAX_FRAME_PIXELS)},
                container_options={
                    "format_whitelist": ",".join(_CONTAINERS),
                    "protocol_whitelist": "none",
                    **(also or {}),
                },
                buffer_size=1 << 16,
                **_ANY_TITLE,
            )
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(f"{path}: {_why_not(path, error, kind)}") from None
        with container:
            yield container


@contextmanager
def create_video(path: Path) -> Iterator[OutputContainer]:
    """Create a video file. The ending of `path` chooses the container."""
    with path.open("wb") as file:
        local = _Local(file, f"video{path.suffix}")
        failed: list[OSError] = []

        def write(content: Any) -> int:
            try:
                return file.write(content)
            except OSError as error:
                failed.append(error)
                raise

        local.write = write
        try:
            with av.open(local, "w") as container:
                yield container
        except av.error.FFmpegError:
            # A container whose pictures could not be written cannot be closed either, which would hide the reason.
            if failed:
                raise failed[0] from None
            raise


def _why_not(path: Path, error: av.error.FFmpegError | OSError, kind: str) -> str:
    """Return what a file that FFmpeg refused is, as far as its beginning shows, and what to do."""
    with path.open("rb") as file:
        start = file.read(4096)
    if _LIST.search(start):
        return "is a playlist, a manifest or a link, which names other files; mien opens none: give the video itself"
    if isinstance(error, av.error.ArgumentError):
        return "is a file of a kind that mien does not open; convert it to .mp4 or .mov"
    if kind == "sound":
        return f"cannot be read as sound ({error.strerror or error}); convert it to .wav or .mp3"
    named_so = path.suffix.lower() in VIDEO_SUFFIXES
    remedy = "incomplete? copy it again" if named_so else "give a video file, such as .mp4 or .mov"
    return f"cannot be read as a video ({error.strerror or error}); {remedy}"


def _moving_pictures(path: Path, container: InputContainer, wanted: int | None) -> VideoStream:
    known = _known_pictures(path, container)
    if wanted is None:
        return _rank(path, known)[0]
    for stream in container.streams.video:
        if stream.index == wanted and stream.codec_context is not None:
            return stream
    others = ", ".join(f"{stream.index} ({stream.width}x{stream.height})" for stream in known)
    raise UserError(f"{path}: --capture.stream {wanted} is no stream of pictures; its streams of pictures are {others}")


def _known_pictures(path: Path, container: InputContainer) -> list[VideoStream]:
    streams = container.streams.video
    if not streams:
        raise UserError(f"{path}: has no video stream; give a file with pictures in it")
    moving = [stream for stream in streams if not stream.disposition & Disposition.attached_pic]
    if not moving:
        raise UserError(f"{path}: has a cover picture, but no video stream; give a file with moving pictures in it")
    # PyAV has no codec context for a codec that FFmpeg does not have.
    known = [stream for stream in moving if stream.codec_context is not None]
    if not known:
        raise UserError(f"{path}: FFmpeg does not know its codec; convert it to H.264")
    return known


def _rank(path: Path, streams: list[_AnyStream]) -> list[_AnyStream]:
    """Return the streams of one kind in the order of `find_streams`."""
    if len(streams) == 1:
        return streams
    packets = _count_packets(path, [stream.index for stream in streams])

    def place(stream: _AnyStream) -> tuple[bool, bool, int, int]:
        pixels = stream.width * stream.height if isinstance(stream, VideoStream) else 0
        is_still = packets[stream.index] < 2 or bool(stream.disposition & _STILLS)
        is_odd = isinstance(stream, VideoStream) and (stream.average_rate or 0) > 1000
        return is_still or is_odd, not stream.disposition & Disposition.default, -pixels, stream.index

    return sorted(streams, key=place)


def _count_packets(path: Path, indices: list[int]) -> Counter[int]:
    """Count the packets of streams, until each has two, or 5,000 have been read."""
    counts: Counter[int] = Counter()
    damage = contextlib.suppress(av.error.FFmpegError, OSError)
    with _open_container(path, "video", {"codec_whitelist": "none"}) as container, damage:
        for packet in itertools.islice(container.demux([container.streams[index] for index in indices]), 5000):
            counts[packet.stream_index] += packet.size > 0
            if all(counts[index] > 1 for index in indices):
                break
    return counts
