"""Step 1: decide what the numbers in a video's pictures mean: transfer function, matrix and range.

A video states its colours in two places, the codec's header and the container, and often only in one of them. This is
the only module that chooses, for the report and for the pictures alike:

1. The codec's header counts, as in FFmpeg's players, value by value.
2. A value that the header leaves unspecified comes from the container: the `colr` box of .mov and .mp4, the `Color`
   element of .mkv and .webm. FFmpeg's decoders of ProRes, HEVC and VP9 forget those.
3. Without either, HDR has the matrix of BT.2020, and other pictures BT.709 from 720 lines up and BT.601 below.

The range needs care: decoders report limited range when the header says nothing. So full range in the container counts
if the header leaves the matrix unspecified. HDR is taken as BT.2020. Its primaries, and those of other pictures that
state BT.2020 or P3, are converted to BT.709 (`mien.media.tone`). All other primaries are shown as BT.709.
"""

from typing import NamedTuple

import av
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace

from mien.media.tone import HLG, PQ

_HDR_NAMES = {PQ: "PQ", HLG: "HLG"}
_RGB, _UNSPECIFIED = 0, 2
_UNKNOWN = (_UNSPECIFIED, 0, 3)
"""Codes that name nothing: reserved ones, and 0, which ProRes writes for an unknown value. As a matrix, 0 is RGB."""
_HIGH_DEFINITION_HEIGHT = 720


class Colors(NamedTuple):
    """Codes of a picture's colours (ITU-T H.273), as FFmpeg numbers them."""

    transfer: int = _UNSPECIFIED
    matrix: int = _UNSPECIFIED
    range: int = ColorRange.UNSPECIFIED
    primaries: int = _UNSPECIFIED

    @property
    def hdr(self) -> str:
        """HDR transfer function: PQ, HLG, or empty for ordinary pictures."""
        return _HDR_NAMES.get(self.transfer, "")


UNSPECIFIED = Colors()


def stated_colors(tagged: av.VideoFrame | VideoCodecContext) -> Colors:
    """Return the tags of a frame or of a codec context."""
    return Colors(int(tagged.color_trc), int(tagged.colorspace), int(tagged.color_range), int(tagged.color_primaries))


def colors_of(frame: av.VideoFrame, container: Colors) -> Colors:
    """Return the colours of a decoded frame whose container states `container`. The matrix is always specified."""
    header = stated_colors(frame)
    if header.matrix == _RGB and frame.format.is_rgb:
        return header
    is_silent = header.matrix in _UNKNOWN
    takes_range = header.range == ColorRange.UNSPECIFIED or (is_silent and container.range == ColorRange.JPEG)
    known = Colors(
        transfer=container.transfer if header.transfer in _UNKNOWN else header.transfer,
        matrix=container.matrix if is_silent else header.matrix,
        range=container.range if takes_range else header.range,
        primaries=container.primaries if header.primaries in _UNKNOWN else header.primaries,
    )
    return known._replace(matrix=_guessed_matrix(known, frame.height)) if known.matrix in _UNKNOWN else known


def _guessed_matrix(colors: Colors, height: int) -> int:
    if colors.hdr:
        return Colorspace.BT2020
    # Players assume BT.709 from 720 lines up and BT.601 below if a file does not name its matrix.
    return Colorspace.ITU709 if height >= _HIGH_DEFINITION_HEIGHT else Colorspace.ITU601
