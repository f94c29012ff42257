"""Step 1: read video files one frame at a time, and write them, with PyAV (no system ffmpeg)."""

import contextlib
import itertools
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import NamedTuple

import av
import av.error
import numpy as np
from av.audio.resampler import AudioResampler
from av.container import InputContainer, OutputContainer
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import Float32, UInt8

from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.machine.progress import say
from mien.media.colors import colors_of
from mien.media.display import ACCURATE, Display, brought_to, has_shape
from mien.media.fields import Deinterlace, FieldOrder, combs, deinterlace
from mien.media.video_file import (
    TOO_MANY_PIXELS,
    create_video,
    find_streams,
    open_sound,
    open_video,
    read_container_tags,
)

_THREADS = 2
DEFAULT_FPS = 25.0
"""Frames a second of a stream that names no rate."""
_WITH_ALPHA = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # decoders that read the alpha of a codec, if others do not


@dataclass(frozen=True)
class VideoInfo:
    """Facts that a video file states about itself. Only decoding shows whether they are true."""

    fps: float
    """Average frames per second."""
    frames: int
    """Expected number of frames; 0 if the file does not state it."""
    hdr: str = ""
    """HDR transfer function: PQ, HLG, or empty for ordinary video."""
    has_field_pictures: bool = False
    """Whether its pictures are single fields of interlaced video, of half the height (HEVC)."""
    stream: int | None = None
    """Index of the stream that is read."""
    other_streams: tuple[int, ...] = ()
    """Indices of the file's other streams of pictures."""


class LazyFrame(NamedTuple):
    """A frame of a source. Its picture, which is the costly part, is made only on request."""

    number: int
    """Index in the source, from 0. Frames that a selection leaves out count, too."""
    seconds: float
    """Time since the first frame, or since the first one that a selection takes."""
    picture: Callable[[], UInt8[np.ndarray, "h w 3"]]
    """Makes the sRGB picture."""
    size: Callable[[], tuple[int, int]]
    """Width and height in pixels of the picture before it is shrunk. They may change within a video."""
    is_deinterlaced: bool = False
    """Whether the picture is made of an interlaced frame."""
    alpha: Callable[[], UInt8[np.ndarray, "h w"] | None] = lambda: None
    """Makes the alpha before it is shrunk; None if there is none or it is opaque. It ignores the lens."""
    combs: Callable[[], float] = lambda: 0.0
    """Measures the combs of the frame as stored, as a part of its pixels (`mien.media.fields.combs`)."""


def probe_video(path: Path, wanted: int | None = None) -> VideoInfo:
    """Return what a video states of the stream `wanted`, by default the first one of `find_streams`."""
    with open_video(path, wanted) as (container, stream):
        fps = float(stream.average_rate or stream.guessed_rate or DEFAULT_FPS)
        if stream.duration is not None and stream.time_base is not None:
            seconds = float(stream.duration * stream.time_base)
        else:
            seconds = (container.duration or 0) / av.time_base
        colors, order = read_container_tags(path, stream.index)
        first = _first_frame(container, stream)
        hdr = colors_of(first, colors).hdr if first is not None else ""
        fields = FieldOrder(stream.codec_context.name, order)
        has_field_pictures = first is not None and first.interlaced_frame and fields.has_field_pictures
        others = tuple(index for index in find_streams(path) if index != stream.index)
        frames = stream.frames or round(seconds * fps)
        return VideoInfo(fps, frames, hdr, has_field_pictures, stream.index, others)


def _first_frame(container: InputContainer, stream: VideoStream) -> av.VideoFrame | None:
    """Return the first frame that can be decoded: only frames say for sure what the codec states."""
    with contextlib.suppress(av.error.FFmpegError, OSError):
        for packet in itertools.islice(container.demux(stream), 100):
            with contextlib.suppress(av.error.FFmpegError):
                for frame in packet.decode():
                    return frame
    return None


def count_frames(path: Path, wanted: int | None = None) -> int:
    """Count the frames in a video's stream (`probe_video`) by reading its packets without decoding them."""
    with open_video(path, wanted) as (container, stream):
        try:
            # An edit list discards frames that others need for decoding.
            return sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))
        except av.error.FFmpegError as error:
            raise UserError(f"{path}: is damaged ({error.strerror or error}); copy or record it again") from None


def read_video_frames(path: Path, longest_side: int = 0) -> Iterator[tuple[float, UInt8[np.ndarray, "h w 3"]]]:
    """Yield every frame in display order: its time in seconds from the first frame, and its sRGB picture.

    Pictures of the first one's shape have its size. Others keep their own.

    The file's rotation and mirror flags and its pixel aspect are applied; HDR is tone-mapped (`mien.media.colors`), and
    interlaced frames are deinterlaced, one picture for each frame (`mien.media.fields`). Damaged parts are skipped
    with a warning. Larger pictures are shrunk by areas to a `longest_side` in pixels, unless that is 0.
    """
    first: tuple[int, int] | None = None
    for frame in read_lazily(path, longest_side):
        picture = frame.picture()
        first = first or (picture.shape[1], picture.shape[0])
        yield frame.seconds, brought_to(picture, first) if has_shape(picture, first) else picture


def read_lazily(
    path: Path, longest_side: int = 0, mode: Deinterlace = "auto", wanted: int | None = None
) -> Generator[LazyFrame, None, None]:
    """Yield frames as `read_video_frames` does, but convert only pictures that are requested."""
    with open_video(path, wanted) as (container, stream):
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = _THREADS
        interval = 1.0 / float(stream.average_rate or stream.guessed_rate or DEFAULT_FPS)
        first: float | None = None
        latest = -interval
        aspect = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
        colors, fields = read_container_tags(path, stream.index)
        display = Display(str(path), float(aspect) if aspect else 1.0, longest_side, colors)
        order = FieldOrder(stream.codec_context.name, fields)
        decoded = deinterlace(_decode(path, container, stream), order, mode)
        for number, (frame, shown, is_deinterlaced) in enumerate(decoded):
            if frame.pts is None or frame.time_base is None:
                seconds = latest + interval
            else:
                absolute = float(frame.pts * frame.time_base)
                first = absolute if first is None else first
                seconds = absolute - first
            # Times must increase for everything that differentiates over time, but broken files repeat them.
            latest = seconds if seconds > latest else latest + interval
            yield LazyFrame(
                number,
                latest,
                partial(display.show, shown),
                partial(display.size_of, shown),
                is_deinterlaced,
                partial(display.alpha, shown),
                partial(combs, frame),
            )


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "h w 3"]],
    fps: int | float,
    crf: int = 18,
    preset: str = "medium",
    sound: tuple[Path, float] | None = None,
) -> None:
    """Write sRGB frames of one size as H.264, atomically. They are read once, so a generator will do.

    The path's ending, usually .mp4, chooses the container. `crf` is x264's constant rate factor: 0 is lossless, 18
    looks lossless, 51 is worst. The preset `veryfast` takes a third of the time and compresses somewhat worse. `sound`
    is a file with sound for the video, and the video's length in seconds.
    """
    # x264's macroblock tree reads memory that it has not written, so equal pictures could give different files.
    encode(path, frames, fps, "libx264", {"crf": str(crf), "preset": preset, "mbtree": "0"}, sound)


def encode(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "h w _"]],
    fps: int | float,
    codec: str,
    options: dict[str, str],
    sound: tuple[Path, float] | None = None,
) -> None:
    """Write RGB or RGBA frames in BT.709, 4:2:0, atomically. Odd sizes get a repeated last row or column."""
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise UserError(f"{path}: no frames to write; check the selection of frames")
    height, width, channels = first.shape
    is_h264 = codec == "libx264"

    def write(aside: Path) -> None:
        with create_video(aside) as container:
            stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001), options=options)
            assert isinstance(stream, VideoStream)
            stream.width, stream.height = width + width % 2, height + height % 2
            stream.pix_fmt = "yuva420p" if channels == 4 else "yuv420p"
            context = stream.codec_context
            if is_h264:
                context.thread_count = _THREADS
            # Players assume BT.709 for matrix, primaries and transfer, and studio range. The file also says so.
            context.colorspace = context.color_primaries = context.color_trc = 1
            context.color_range = ColorRange.MPEG
            packets = _add_sound(container, *sound) if sound is not None else iter(())
            heard = next(packets, None)
            reformatter = VideoReformatter()
            for number, image in enumerate(itertools.chain([first], iterator)):
                # Sound goes into the file just before the pictures of its time.
                while heard is not None and float((heard.pts or 0) * (heard.time_base or 0)) <= number / fps:
                    container.mux(heard)
                    heard = next(packets, None)
                assert image.shape == first.shape, f"frames of {first.shape}, then one of {image.shape}"
                assert image.dtype == np.uint8, image.dtype
                even = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                frame = reformatter.reformat(
                    av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgba" if channels == 4 else "rgb24"),
                    format=stream.pix_fmt,
                    dst_colorspace=Colorspace.ITU709,
                    dst_color_range=ColorRange.MPEG,
                    interpolation=ACCURATE if is_h264 else None,
                )
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
            container.mux([packet for packet in (heard, *packets) if packet is not None])

    write_atomically(path, write)


def _decoder(stream: VideoStream) -> Callable[[av.Packet], list[av.VideoFrame]]:
    """Return what decodes the packets of a stream. FFmpeg's own decoders of VP8 and VP9 leave out the alpha."""
    name = _WITH_ALPHA.get(stream.codec_context.name)
    if name is None or stream.metadata.get("alpha_mode") != "1":
        return lambda packet: [frame for frame in packet.decode() if isinstance(frame, av.VideoFrame)]
    context = av.CodecContext.create(name, "r")
    assert isinstance(context, VideoCodecContext)
    context.options = stream.codec_context.options

    def decode(packet: av.Packet) -> list[av.VideoFrame]:
        frames = context.decode(packet if packet.size else None)
        for frame in frames:
            frame.time_base = stream.time_base
        return frames

    return decode


def _decode(path: Path, container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame]:
    """Yield all frames. Parts that cannot be decoded are skipped, counted, and reported at the end."""
    damaged, decoded = 0, 0
    packets, decode = container.demux(stream), _decoder(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            damaged += 1
            break
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror}); copy it again") from None
        if packet is None:
            break
        try:
            frames = decode(packet)
        except av.error.FFmpegError:
            damaged += 1
            continue
        for frame in frames:
            decoded += 1
            yield frame
    if decoded == 0:
        raise UserError(
            f"{path}: no frame of the video can be decoded (it is damaged, or has {TOO_MANY_PIXELS}); convert it to "
            "H.264 or record it again"
        )
    if damaged:
        say(f"warning: {path}: {damaged} damaged parts of the video were skipped")


RATE = 16_000
"""Samples a second of `read_sound`."""
_MOST_SECONDS = 3600.0
_LEAST_RATE, _MOST_RATE = 1_000, 768_000  # bounds of the samples a second of a file
_WRITTEN_RATE = 48_000


def read_sound(path: Path) -> Float32[np.ndarray, " n"]:
    """The sound of a file as one channel, -1..1, with `RATE` samples a second."""
    # FFmpeg would make one channel of two louder than each.
    parts = [frame.to_ndarray().mean(0) for frame in _resampled(path, None, RATE)]
    return np.nan_to_num(np.concatenate(parts).astype(np.float32))


def _add_sound(container: OutputContainer, path: Path, seconds: float) -> Iterator[av.Packet]:
    """Yield the packets (AAC) of a new stream with a file's sound. The container's other streams are there already.

    Sound that is longer than the video is cut, and shorter sound is followed by silence.
    """
    stream = container.add_stream("aac", rate=_WRITTEN_RATE, layout="stereo")
    stream.bit_rate = 160_000
    samples, done = round(seconds * _WRITTEN_RATE), 0
    for frame in (*_resampled(path, "stereo", _WRITTEN_RATE), None):
        if done >= samples:
            break
        content = np.zeros((2, samples - done), np.float32) if frame is None else frame.to_ndarray()
        content = np.ascontiguousarray(content[:, : samples - done], np.float32)
        if content.shape[1] == 0:
            continue
        piece = av.AudioFrame.from_ndarray(content, format="fltp", layout="stereo")
        piece.sample_rate, piece.time_base, piece.pts = _WRITTEN_RATE, Fraction(1, _WRITTEN_RATE), done
        done += content.shape[1]
        yield from stream.encode(piece)
    yield from stream.encode()


def _resampled(path: Path, layout: str | None, rate: int) -> Iterator[av.AudioFrame]:
    """The decoded sound. Damaged parts after the beginning are left out."""
    count = 0
    with open_sound(path) as (container, stream):
        for piece in _converted(path, _decoded(container, stream), layout, rate):
            count += piece.samples
            if count > _MOST_SECONDS * rate:
                raise UserError(f"{path}: is longer than an hour; cut it into shorter files")
            yield piece
    if count == 0:
        raise UserError(f"{path}: no sound of it can be decoded; convert it to .wav or record it again")


def _decoded(container: InputContainer, stream: av.AudioStream) -> Iterator[av.AudioFrame]:
    """The frames up to the first that cannot be decoded."""
    with contextlib.suppress(av.error.FFmpegError, OSError):
        yield from container.decode(stream)


def _converted(path: Path, frames: Iterator[av.AudioFrame], layout: str | None, rate: int) -> Iterator[av.AudioFrame]:
    """The frames in another format. The first one whose rate or channels differ from those before begins anew."""
    resampler, kind = None, None
    try:
        for frame in frames:
            if not _LEAST_RATE <= frame.sample_rate <= _MOST_RATE:
                raise UserError(
                    f"{path}: has {frame.sample_rate:,} samples a second, not {_LEAST_RATE:,} to {_MOST_RATE:,}; "
                    "convert it to .wav or record it again"
                )
            found = (frame.sample_rate, frame.layout.name, frame.format.name)
            if resampler is None or found != kind:
                if resampler is not None:
                    yield from resampler.resample(None)
                resampler, kind = AudioResampler(format="fltp", layout=layout, rate=rate), found
            yield from resampler.resample(frame)
        if resampler is not None:
            yield from resampler.resample(None)
    except (av.error.FFmpegError, ValueError) as error:
        raise UserError(
            f"{path}: its sound cannot be converted ({error}); convert it to .wav or record it again"
        ) from None
