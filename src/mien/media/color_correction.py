"""Correct the colours of a camera by a polynomial, as measured with a colour chart.

The polynomial is that of Cheung et al. 2004 ("A comparative study of the characterisation of colour cameras by means of
neural networks and polynomial transforms"). It takes linear light, not sRGB values.
"""

from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from mien.disk.limits import MAX_NUMBER
from mien.errors import UserError
from mien.media.colors import srgb_signal

NAME = "color_correction"
_CHUNK = 1 << 14  # pixels that are computed at once
_STEPS = 1 << 16  # values of linear light for which the sRGB value is kept, at most 0.05 of an 8-bit level apart

_LINEAR, _PAIRS, _SQUARES, _CUBES = "r g b", "rg rb gb", "rr gg bb", "rrr ggg bbb"
_TEN = f"{_LINEAR} {_PAIRS} {_SQUARES} rgb"
_THIRTEEN = f"{_TEN} rrg ggb bbr"
_NINETEEN = f"{_THIRTEEN} rrb ggr bbg {_CUBES}"
_FOURTH = "rrrg rrrb gggr gggb bbbr bbbg rrgb rggb rgbb rrgg rrbb ggbb rrrr gggg bbbb"
_TERMS = {
    len(terms): terms
    for terms in (
        tuple(each.split())
        for each in (
            _LINEAR, f"{_LINEAR} 1", f"{_LINEAR} rgb 1", f"{_LINEAR} {_PAIRS} 1", f"{_LINEAR} {_PAIRS} rgb 1",
            f"{_LINEAR} {_PAIRS} {_SQUARES} 1", f"{_TEN} 1", f"{_TEN} {_CUBES} 1", f"{_THIRTEEN} {_CUBES}",
            f"{_THIRTEEN} {_CUBES} 1", _NINETEEN, f"{_NINETEEN} 1", f"{_NINETEEN} rrgb rggb rgbb",
            f"{_NINETEEN} {_FOURTH} 1",
        )
    )
}  # fmt: skip
"""The terms of each polynomial, in order, by their number. A term is the product of its channels; 1 is the constant."""


@dataclass(frozen=True, eq=False)
class ColorCorrection:
    """A polynomial of linear light for each channel."""

    matrix: Float[np.ndarray, "3 n"]
    """Coefficients of red, green and blue, in the order of the polynomial's n terms."""

    def apply(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the sRGB picture with corrected colours, rounded. Light below 0 or above 1 is cut off."""
        to_light, to_srgb = _tables()
        terms, matrix = _TERMS[self.matrix.shape[1]], self.matrix.astype(np.float32)
        pixels = np.ascontiguousarray(picture).reshape(-1, 3)
        corrected = np.empty_like(pixels)
        for start in range(0, len(pixels), _CHUNK):
            channels = dict(zip("rgb", to_light[pixels[start : start + _CHUNK].T], strict=True))
            channels["1"] = np.ones_like(channels["r"])
            found = matrix @ np.stack([reduce(np.multiply, map(channels.get, term)) for term in terms])
            steps = (np.clip(found, 0, 1) * (_STEPS - 1) + np.float32(0.5)).astype(np.intp)
            corrected[start : start + _CHUNK] = to_srgb[steps].T
        return corrected.reshape(picture.shape)


def color_correction(matrix: Float[np.ndarray, "3 n"], where: str) -> ColorCorrection:
    """The correction with these coefficients; `where` begins the message."""
    if matrix.shape[1] not in _TERMS:
        raise UserError(
            f"{where}: has {matrix.shape[1]} terms for each channel; polynomials of Cheung 2004 have "
            f"{', '.join(map(str, sorted(_TERMS)))}"
        )
    return ColorCorrection(matrix)


def correction_of_entry(entry: dict[str, Any], where: str) -> ColorCorrection | None:
    """Return the correction in a camera's entry of a calibration file, or None if it has none."""
    given = entry.get(NAME)
    if given is None:
        return None
    try:
        matrix = np.asarray(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.full(1, np.nan)
    if matrix.ndim != 2 or len(matrix) != 3 or not np.abs(matrix).max(initial=0) <= MAX_NUMBER:
        raise UserError(
            f"{where}: {NAME} {given!r:.60} is not three rows of numbers; give the coefficients of each channel"
        )
    return color_correction(matrix, f"{where}: {NAME}")


@lru_cache(maxsize=1)
def _tables() -> tuple[Float[np.ndarray, " 256"], UInt8[np.ndarray, " s"]]:
    """Return the light of each 8-bit sRGB value, and the sRGB value of each step of light (IEC 61966-2-1)."""
    srgb = np.arange(256) / 255
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32), np.rint(255 * srgb_signal(np.arange(_STEPS) / (_STEPS - 1))).astype(np.uint8)
