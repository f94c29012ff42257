"""The sound of a file: read as samples, and written beside the pictures of a video."""

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import av.error
import numpy as np
from av.audio.resampler import AudioResampler
from av.container import InputContainer, OutputContainer
from jaxtyping import Float32

from mien.errors import UserError
from mien.media.video_file import open_sound

RATE = 16_000
"""Samples a second of `read_sound`."""
_MOST_SECONDS = 3600.0
_LEAST_RATE, _MOST_RATE = 1_000, 768_000
"""Bounds of the samples a second of a file."""
_WRITTEN_RATE = 48_000
_WRITTEN_BITS = 160_000


def read_sound(path: Path) -> Float32[np.ndarray, " n"]:
    """The sound of a file as one channel, -1..1, with `RATE` samples a second."""
    # FFmpeg would make one channel of two louder than each.
    parts = [frame.to_ndarray().mean(0) for frame in _resampled(path, "fltp", None, RATE)]
    return np.nan_to_num(np.concatenate(parts).astype(np.float32))


def add_sound(container: OutputContainer, path: Path, seconds: float) -> Iterator[av.Packet]:
    """Add a stream with a file's sound to a video that is written, and yield its packets (AAC).

    Args:
        container: The video. Its other streams are there already.
        path: The file.
        seconds: Length of the video. Longer sound is cut, and shorter sound is followed by silence.
    """
    stream = container.add_stream("aac", rate=_WRITTEN_RATE, layout="stereo")
    stream.bit_rate = _WRITTEN_BITS
    return _packets(stream, path, round(seconds * _WRITTEN_RATE))


def _packets(stream: "av.AudioStream", path: Path, samples: int) -> Iterator[av.Packet]:
    done = 0
    for frame in (*_resampled(path, "fltp", "stereo", _WRITTEN_RATE), None):
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


def _resampled(path: Path, sample: str, layout: str | None, rate: int) -> Iterator[av.AudioFrame]:
    """The decoded sound. Damaged parts after the beginning are left out."""
    count = 0
    with open_sound(path) as (container, stream):
        for piece in _converted(path, _decoded(container, stream), sample, layout, rate):
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


def _converted(
    path: Path, frames: Iterator[av.AudioFrame], sample: str, layout: str | None, rate: int
) -> Iterator[av.AudioFrame]:
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
                resampler, kind = AudioResampler(format=sample, layout=layout, rate=rate), found
            yield from resampler.resample(frame)
        if resampler is not None:
            yield from resampler.resample(None)
    except (av.error.FFmpegError, ValueError) as error:
        raise UserError(
            f"{path}: its sound cannot be converted ({error}); convert it to .wav or record it again"
        ) from None
