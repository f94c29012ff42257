"""Step 1: interlaced video. Its frames hold two moments, one in the even and one in the odd lines.

Each interlaced frame becomes one picture of its first moment, by FFmpeg's bwdif. So 50 fields a second give 25
pictures. Frames keep their number and times, by which the user's mattes and landmarks are counted, and a capture takes
no more space and training than before. The second moments would add little: a head hardly moves in 20 ms.

Frames that do not say that they are interlaced pass unchanged, bit by bit.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import Literal, NamedTuple

import av
import av.error
import numpy as np
from av.filter import Graph
from av.filter.context import FilterContext
from jaxtyping import UInt8

_TOP_FIRST, _BOTTOM_FIRST = (2, 4), (3, 5)
"""FFmpeg's codes of the order of fields. Programs use both codes of a pair alike."""
_STATES_FIELDS = frozenset(
    {"h264", "hevc", "vvc", "mpeg1video", "mpeg2video", "mpeg4", "vc1", "prores", "dnxhd", "dvvideo", "mjpeg"}
)
"""Codecs that mark each frame as interlaced or not. For others, the container speaks for all frames."""
_LEAST_SIDE = 4  # smaller pictures are passed unchanged: bwdif refuses them
_COMB = 8  # least difference of neighbouring lines in a comb, in levels of 255
_COMB_PIXELS = 1 << 20  # pixels in which combs are counted. In larger pictures, columns are left out

Deinterlace = Literal["auto", "always", "never"]
"""auto deinterlaces the frames that are marked as interlaced, by themselves or by their container; always all; never
none."""


class FieldFrame(NamedTuple):
    """A decoded frame and the picture to show in its place."""

    stored: av.VideoFrame
    """The frame as decoded. Its time counts."""
    shown: av.VideoFrame
    is_deinterlaced: bool


class FieldOrder(NamedTuple):
    """What a stream says about the fields of all its frames."""

    codec: str
    container_order: int = 0
    """FFmpeg's code of the order that the container states; 0 if it states none."""

    @property
    def has_field_pictures(self) -> bool:
        """Whether interlaced pictures are single fields, of half the height. FFmpeg does not join them."""
        return self.codec == "hevc"

    @property
    def parity(self) -> str:
        """Which field comes first if frames do not say it: tff, bff, or auto for unknown."""
        order = self.container_order
        return "tff" if order in _TOP_FIRST else "bff" if order in _BOTTOM_FIRST else "auto"

    @property
    def is_interlaced(self) -> bool:
        """Whether the container speaks for frames that cannot say it themselves."""
        return self.parity != "auto" and self.codec not in _STATES_FIELDS


def deinterlace(frames: Iterable[av.VideoFrame], order: FieldOrder, mode: Deinterlace) -> Iterator[FieldFrame]:
    """Yield every decoded frame with its picture, in order. At most two frames are held."""
    graph: _Graph | None = None
    for frame in frames:
        if graph is not None and not graph.fits(frame):
            yield from graph.finish()
            graph = None
        unfit = order.has_field_pictures or min(frame.width, frame.height) < _LEAST_SIDE
        marked = frame.interlaced_frame or order.is_interlaced
        if graph is None and not unfit and (mode == "always" or (mode == "auto" and marked)):
            graph = _Graph(frame, order, mode)
        if graph is None:
            yield FieldFrame(frame, frame, False)
        else:
            yield from graph.push(frame)
    if graph is not None:
        yield from graph.finish()


class _Graph:
    def __init__(self, first: av.VideoFrame, order: FieldOrder, mode: Deinterlace) -> None:
        self._kind = _kind(first)
        self._takes_all = mode == "always" or order.is_interlaced
        parity = "auto" if first.interlaced_frame else order.parity
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=first.width, height=first.height, format=first.format, time_base=first.time_base or Fraction(1, 1000)
        )
        wanted = f"mode=send_frame:parity={parity}:deint={'all' if self._takes_all else 'interlaced'}"
        steps: list[FilterContext] = [source, self._graph.add("bwdif", wanted), self._graph.add("buffersink")]
        self._graph.link_nodes(*steps).configure()
        self._waiting: deque[av.VideoFrame] = deque()

    def fits(self, frame: av.VideoFrame) -> bool:
        return _kind(frame) == self._kind

    def push(self, frame: av.VideoFrame) -> Iterator[FieldFrame]:
        """Take the next frame, and yield those that are ready: the filter looks one frame ahead."""
        self._waiting.append(frame)
        self._graph.vpush(frame)
        yield from self._pull()

    def finish(self) -> Iterator[FieldFrame]:
        self._graph.vpush(None)
        yield from self._pull()
        assert not self._waiting, len(self._waiting)

    def _pull(self) -> Iterator[FieldFrame]:
        while self._waiting:
            try:
                shown = self._graph.vpull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return
            stored = self._waiting.popleft()
            yield FieldFrame(stored, shown, self._takes_all or stored.interlaced_frame)


def _kind(frame: av.VideoFrame) -> tuple[int, int, str]:
    return frame.width, frame.height, frame.format.name


def combs(frame: av.VideoFrame) -> float:
    """Return the part of a frame, at most 1, in which neighbouring lines alternate between two moments.

    A pixel counts if three successive differences down its column have alternating signs and are large. Noise and fine
    patterns do that too, but along rows as well, so what rows have is subtracted. Progressive pictures are near 0.
    """
    gray = frame.reformat(format="gray").to_ndarray()
    skipped = 1 + gray.size // _COMB_PIXELS
    if min(gray.shape) < _LEAST_SIDE * skipped:
        return 0.0
    return _alternating(gray[:, ::skipped]) - _alternating(gray.T[:, ::skipped])


def _alternating(lines: UInt8[np.ndarray, "h w"]) -> float:
    steps = np.diff(lines.astype(np.int16), axis=0)
    steps[1::2] *= -1
    first, second, third = steps[:-2], steps[1:-1], steps[2:]
    rising = np.minimum(np.minimum(first, second), third) > _COMB
    falling = np.maximum(np.maximum(first, second), third) < -_COMB
    return float((rising | falling).mean())
