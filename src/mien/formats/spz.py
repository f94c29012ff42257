"""The .spz format (Niantic, versions 3 and 4): Gaussians with 8 to 24 bits a number, column by column.

Version 3 is one gzip stream. Version 4 has a plain header, a table with the sizes of its columns, and each column as a
Zstandard stream of its own; columns without a number are left out. Source: the README of github.com/nianticlabs/spz,
which describes the headers, the order of the columns and their bits.
"""

import gzip
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.formats.format import Content, PoseOptions, pose_words
from mien.formats.shared.splats import finite_arrays, unit_quats

if TYPE_CHECKING:
    import mien.gaussians

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, count, degree, bits behind the point, flags, and in version 4 the number of columns."""
_TABLE_AT, _ENTRY = 32, struct.Struct("<QQ")
"""Where the table of version 4 lies if there are no extensions, and an entry of it: size packed and unpacked, in
bytes."""
_FIXED_BITS = 23
"""Bits of a position without its sign."""
_COLOR_SCALE = 0.15
_LOG_SCALE_OFFSET, _LOG_SCALE_STEPS = 10, 16
_SH_STEPS = 128
_QUAT_STEPS = 511


@dataclass(frozen=True)
class SpzOptions(PoseOptions):
    """Options of .spz files."""

    spz_version: Literal[3, 4] = 4
    """Version of the format. PlayCanvas reads only 4, and older programs only 3."""


def write_spz(path: Path, gaussians: "mien.gaussians.Gaussians", version: Literal[3, 4] = 4) -> None:
    """Write unbatched Gaussians in world space as .spz: +x right, +y up, +z to the viewer, in metres.

    Positions have steps of 2^-16 m (of more if one is beyond 128 m), scales steps of 6 %, colour coefficients steps of
    0.026 (0.0073 in colour), opacities steps of 1/255, higher coefficients steps of 1/128 within -1 to 1, and rotations
    10 bits for each of the three smallest components. The same Gaussians give the same bytes.
    """
    means, quats, scales, opacities, sh = finite_arrays(path, gaussians)
    reach = float(np.abs(means).max(initial=0))
    fraction = min(16, math.floor(math.log2((2**_FIXED_BITS - 1) / max(reach, 1e-6))))
    if fraction < 0:
        raise UserError(f"{path}: a Gaussian is {reach:.3g} m away, too far for .spz; write a .ply")
    fixed = np.round(means.astype(np.float64) * 2**fraction).astype("<i4")
    columns = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3], _bytes(opacities * 255),
        _bytes((sh[:, 0] * _COLOR_SCALE + 0.5) * 255),
        _bytes((np.log(np.maximum(scales, 1e-30)) + _LOG_SCALE_OFFSET) * _LOG_SCALE_STEPS),
        _packed_quats(unit_quats(quats)), _bytes(sh[:, 1:] * _SH_STEPS + _SH_STEPS),
    )  # fmt: skip
    parts, facts = [column.tobytes() for column in columns], (len(means), math.isqrt(sh.shape[1]) - 1, fraction, 0)
    if version == 3:
        data = gzip.compress(_HEADER.pack(_MAGIC, version, *facts, 0) + b"".join(parts), mtime=0)
    else:
        data = _in_version_4([part for part in parts if part], facts)
    write_atomically(path, lambda temporary: temporary.write_bytes(data))


def _in_version_4(parts: list[bytes], facts: tuple[int, ...]) -> bytes:
    import zstandard

    # A quarter of a second for 40,000 Gaussians, and 3 % smaller than by the default level.
    compressor = zstandard.ZstdCompressor(level=19)
    packed = [compressor.compress(part) for part in parts]
    header = _HEADER.pack(_MAGIC, 4, *facts, len(parts)) + struct.pack("<I", _TABLE_AT)
    table = b"".join(_ENTRY.pack(len(small), len(part)) for small, part in zip(packed, parts, strict=True))
    return b"".join([header.ljust(_TABLE_AT, b"\0"), table, *packed])


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions wxyz in 32 bits: the index of the largest component of xyzw, and sign and size of the other three."""
    turned = quats[:, [1, 2, 3, 0]]
    largest = np.abs(turned).argmax(1)
    turned = turned * np.where(np.take_along_axis(turned, largest[:, None], 1) < 0, -1, 1)
    size = np.clip(np.round(np.abs(turned) * np.sqrt(2) * _QUAT_STEPS), 0, _QUAT_STEPS).astype(np.uint32)
    fields = size | ((turned < 0).astype(np.uint32) << 9)
    word = largest.astype(np.uint32)
    for component in range(4):
        word = np.where(largest == component, word, (word << 10) | fields[:, component])
    return word.astype("<u4").view(np.uint8).reshape(-1, 4)


def write(path: Path, content: Content, options: SpzOptions) -> str:
    """Write the file, and return what is told of it."""
    write_spz(path, content.pose(), options.spz_version)
    return pose_words(path, content)
