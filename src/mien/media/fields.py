"""Step 1: interlaced video. Its frames hold two moments, one in the even and one in the odd lines.

Each interlaced frame becomes one picture of its first moment, by FFmpeg's bwdif. So 50 fields a second give 25
pictures. Frames keep their number and times, by which the user's mattes and landmarks are counted, and a capture takes
no more space and training than before. The second moments would add little: a head hardly moves in 20 ms.

Frames that do not say that they are interlaced pass unchanged, bit by bit.
"""

import contextlib
import itertools
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
    """Yield every decoded frame with its picture, in order. At most three frames are held."""
    for (width, height, _), alike in itertools.groupby(
        frames, lambda frame: (frame.width, frame.height, frame.format.name)
    ):
        if mode == "never" or order.has_field_pictures or min(width, height) < _LEAST_SIDE:
            yield from (FieldFrame(frame, frame, False) for frame in alike)
        else:
            yield from _deinterlaced(alike, order, mode == "always" or order.is_interlaced)


def _deinterlaced(frames: Iterable[av.VideoFrame], order: FieldOrder, takes_all: bool) -> Iterator[FieldFrame]:
    """Deinterlace frames of one size and format, from the first that is marked on."""
    graph: Graph | None = None
    waiting: deque[av.VideoFrame] = deque()
    for frame in itertools.chain(frames, (None,)):
        if graph is None and frame is not None and (takes_all or frame.interlaced_frame):
            graph = _filter(frame, order, takes_all)
        if graph is None:
            if frame is not None:
                yield FieldFrame(frame, frame, False)
            continue
        if frame is not None:
            waiting.append(frame)
        graph.vpush(frame)
        # The filter looks one frame ahead.
        with contextlib.suppress(av.error.BlockingIOError, av.error.EOFError):
            while waiting:
                shown, stored = graph.vpull(), waiting.popleft()
                yield FieldFrame(stored, shown, takes_all or stored.interlaced_frame)
    assert not waiting, len(waiting)


def _filter(first: av.VideoFrame, order: FieldOrder, takes_all: bool) -> Graph:
    parity = "auto" if first.interlaced_frame else order.parity
    graph = Graph()
    source = graph.add_buffer(
        width=first.width, height=first.height, format=first.format, time_base=first.time_base or Fraction(1, 1000)
    )
    wanted = f"mode=send_frame:parity={parity}:deint={'all' if takes_all else 'interlaced'}"
    steps: list[FilterContext] = [source, graph.add("bwdif", wanted), graph.add("buffersink")]
    graph.link_nodes(*steps).configure()
    return graph


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
