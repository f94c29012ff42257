"""Step 1: decide what the numbers in a video's pictures mean (transfer function, matrix, range), and convert to sRGB.

A video states its colours in two places, the codec's header and the container, and often only in one of them. This is
the only module that chooses, for the report and for the pictures alike:

1. The codec's header counts, as in FFmpeg's players, value by value.
2. A value that the header leaves unspecified comes from the container: the `colr` box of .mov and .mp4, the `Color`
   element of .mkv and .webm. FFmpeg's decoders of ProRes, HEVC and VP9 forget those.
3. Without either, HDR has the matrix of BT.2020, and other pictures BT.709 from 720 lines up and BT.601 below.

The range needs care: decoders report limited range when the header says nothing. So full range in the container counts
if the header leaves the matrix unspecified. HDR is taken as BT.2020. Its primaries, and those of other pictures that
state BT.2020 or P3, are converted to BT.709. All other primaries are shown as BT.709.

HDR is mapped to 0..255 by one fixed curve, the same for every frame and every clip, so a face keeps its colours when
the scene around it changes:

1. Signal to light: PQ by SMPTE ST 2084 (cd/m2); HLG by BT.2100 with its OOTF for a screen of 1,000 cd/m2 (gamma 1.2).
2. Diffuse white, 203 cd/m2 (BT.2408), becomes 1.0. BT.2020 is converted to BT.709; colours outside are clipped.
3. Light up to 0.75 of diffuse white stays as it is. Above, the brightest channel follows the extended Reinhard curve,
   which continues the line without a kink and reaches 1.0 at 1,000 cd/m2. All three channels are scaled alike, so hues
   stay.
4. sRGB's transfer function, 8 bit.
"""

from functools import cache
from typing import NamedTuple

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import Float, UInt8, UInt16

PQ, HLG = 16, 18
"""Codes of the transfer functions in video files (ITU-T H.273)."""
_RGB, _UNSPECIFIED = 0, 2
_UNKNOWN = (_UNSPECIFIED, 0, 3)
"""Codes that name nothing: reserved ones, and 0, which ProRes writes for an unknown value. As a matrix, 0 is RGB."""
_HDR_WHITE = 203.0  # light in cd/m2 of diffuse white in HDR. ITU-R BT.2408
_HDR_PEAK = 1000.0  # brightest light in cd/m2 that is shown below white. The peak of BT.2100's nominal HLG display
_HDR_KNEE = 0.75  # share of diffuse white above which light is compressed. Set by eye
_SIXTEEN_BIT_WHITE = 65280  # white in swscale's 16-bit pictures: 255 * 256
_SIGNAL_BITS = 12  # bits of the 16 that are used: sources have ten or twelve
_LIGHT_STEPS = 16384  # entries of the sRGB curve. Where it is steepest, an entry is a fifth of a level
_BT2020_TO_BT709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]], np.float32
)
"""ITU-R BT.2407, section 2."""
_P3_TO_BT709 = np.array(
    [[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]], np.float32
)
"""Both have the white D65."""
_WIDE = {9: _BT2020_TO_BT709, 12: _P3_TO_BT709}  # matrices to BT.709 by the code of the primaries (ITU-T H.273)
_BT2020_LUMA = np.array([[0.2627, 0.6780, 0.0593]], np.float32)


class Colors(NamedTuple):
    """Codes of a picture's colours (ITU-T H.273), as FFmpeg numbers them."""

    transfer: int = _UNSPECIFIED
    matrix: int = _UNSPECIFIED
    range: int = ColorRange.UNSPECIFIED
    primaries: int = _UNSPECIFIED

    @property
    def hdr(self) -> str:
        """HDR transfer function: PQ, HLG, or empty for ordinary pictures."""
        return {PQ: "PQ", HLG: "HLG"}.get(self.transfer, "")


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
    # Players assume BT.709 from 720 lines up and BT.601 below if a file does not name its matrix.
    guessed = Colorspace.ITU709 if frame.height >= 720 else Colorspace.ITU601
    guessed = Colorspace.BT2020 if known.hdr else guessed
    return known._replace(matrix=guessed) if known.matrix in _UNKNOWN else known


class ToneMapper:
    """Converts HDR pictures of one transfer function to sRGB."""

    def __init__(self, transfer: int) -> None:
        assert transfer in (PQ, HLG), transfer
        self._is_hlg = transfer == HLG
        entries = (_SIXTEEN_BIT_WHITE >> (16 - _SIGNAL_BITS)) + 1
        signal = np.minimum(np.arange(1 << _SIGNAL_BITS) / (entries - 1), 1)
        decoded = hlg_scene_light(signal) if self._is_hlg else pq_light(signal) / _HDR_WHITE
        self._light = decoded.astype(np.float32)

    def to_srgb(self, picture: UInt16[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Convert a picture of 16-bit non-linear R'G'B' in BT.2020."""
        import cv2

        light = self._light[picture >> (16 - _SIGNAL_BITS)]
        if self._is_hlg:
            luminance = cv2.transform(light, _BT2020_LUMA)
            light *= ((_HDR_PEAK / _HDR_WHITE) * np.power(luminance, 0.2))[..., None]
        light = cv2.transform(light, _BT2020_TO_BT709)
        brightest = light.max(axis=-1)
        bright = brightest > _HDR_KNEE
        if bright.any():
            values = brightest[bright]
            light[bright] *= (roll_off(values) / values)[:, None]
        np.clip(light, 0, 1, out=light)
        light *= _LIGHT_STEPS - 1
        return _levels_of_light()[np.rint(light).astype(np.uint16)]


def is_wide(primaries: int) -> bool:
    """Whether primaries (ITU-T H.273) are wide ones that are converted."""
    return primaries in _WIDE


def narrowed(picture: UInt8[np.ndarray, "h w 3"], primaries: int) -> UInt8[np.ndarray, "h w 3"]:
    """Convert a picture of wide primaries to those of sRGB. Greys stay, and colours outside are clipped.

    The transfer function is taken for that of sRGB, as for all video that is not HDR.
    """
    import cv2

    light = cv2.transform(_light_of_levels()[picture], _WIDE[primaries])
    np.clip(light, 0, 1, out=light)
    return _levels_of_light()[np.rint(light * (_LIGHT_STEPS - 1)).astype(np.uint16)]


def pq_light(signal: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return the light in cd/m2 of a PQ signal in 0..1 (SMPTE ST 2084, EOTF)."""
    powered = np.power(signal, 32 / 2523)
    return 10000 * np.power(np.maximum(powered - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * powered), 8192 / 1305)


def hlg_scene_light(signal: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return the scene light 0..1 of an HLG signal in 0..1 (BT.2100, inverse OETF)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, np.square(signal) / 3, (np.exp((signal - c) / a) + b) / 12)


def roll_off(light: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Compress light above the knee (1 = diffuse white) into the range between the knee and 1."""
    knee, peak = _HDR_KNEE, _HDR_PEAK / _HDR_WHITE
    room = 1 - knee
    above = (np.minimum(light, peak) - knee) / room
    most = (peak - knee) / room
    return knee + room * above * (1 + above / most**2) / (1 + above)


def srgb_signal(light: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """Return the sRGB signal 0..1 of linear light 0..1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(np.maximum(light, 1e-9), 1 / 2.4) - 0.055)


@cache
def _levels_of_light() -> UInt8[np.ndarray, " n"]:
    """Return sRGB's levels of `_LIGHT_STEPS` steps of light from 0 to 1."""
    return np.rint(255 * srgb_signal(np.arange(_LIGHT_STEPS) / (_LIGHT_STEPS - 1))).astype(np.uint8)


@cache
def _light_of_levels() -> Float[np.ndarray, " 256"]:
    light = np.linspace(0, 1, 1 << 16)
    return np.interp(np.arange(256) / 255, srgb_signal(light), light).astype(np.float32)
