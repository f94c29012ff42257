"""The .spz format (Niantic, versions 3 and 4): Gaussians with 8 to 24 bits a number, column by column.

Version 3 is one gzip stream. Version 4 has a plain header, a table with the sizes of its columns, and each column as a
Zstandard stream of its own; columns without a number are left out. Source: the README of github.com/nianticlabs/spz,
which describes the headers, the order of the columns and their bits.
"""

import gzip
import io
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mien.disk.files import write_atomically
from mien.disk.reading import read_bytes
from mien.errors import UserError
from mien.formats.format import Content, PoseOptions, pose_words
from mien.formats.shared.splats import MAX_GAUSSIANS, finite_arrays, gaussians_of, unit_quats

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
_MAX_BYTES = 1 << 28


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


def read_spz(path: Path) -> "mien.gaussians.Gaussians":
    """Read a .spz file of version 2 (whose quaternions have three bytes), 3 or 4."""
    try:
        packed = read_bytes(path, _MAX_BYTES)
        read = _read_version_4 if packed[:4] == struct.pack("<I", _MAGIC) else _read_gzip
        fraction, columns = read(packed)
    except Exception as error:  # damaged streams may fail in any way
        reason = getattr(error, "strerror", None) or error
        remedy = "give a .spz of version 2, 3 or 4; `mien export` writes 4"
        raise UserError(f"{path}: cannot be read as .spz ({reason}); {remedy}") from None
    places, opacities, colors, scales, quats, higher = columns
    count = len(places)
    wide = np.concatenate([np.zeros((count, 3, 1), np.uint8), places], axis=2)
    means = (wide.reshape(count, 12).view("<i4") >> 8) / 2**fraction
    first = (colors.astype(np.float32) / 255 - 0.5) / _COLOR_SCALE
    higher = higher.astype(np.float32)
    higher -= _SH_STEPS  # in place: these are most of the numbers
    higher /= _SH_STEPS
    sh = np.concatenate([first[:, None], higher], axis=1)
    quats = _unpacked_quats(quats) if quats.shape[1] == 4 else _unpacked_first_three(quats)
    scales = np.exp(scales.astype(np.float64) / _LOG_SCALE_STEPS - _LOG_SCALE_OFFSET)
    return gaussians_of((means, quats, scales, opacities / 255, sh))


def _in_version_4(parts: list[bytes], facts: tuple[int, ...]) -> bytes:
    import zstandard

    # A quarter of a second for 40,000 Gaussians, and 3 % smaller than by the default level.
    compressor = zstandard.ZstdCompressor(level=19)
    packed = [compressor.compress(part) for part in parts]
    header = _HEADER.pack(_MAGIC, 4, *facts, len(parts)) + struct.pack("<I", _TABLE_AT)
    table = b"".join(_ENTRY.pack(len(small), len(part)) for small, part in zip(packed, parts, strict=True))
    return b"".join([header.ljust(_TABLE_AT, b"\0"), table, *packed])


def _shapes(count: int, degree: int, quat_bytes: int = 4) -> list[tuple[int, ...]]:
    if count > MAX_GAUSSIANS:
        raise ValueError(f"it has {count:,} Gaussians, and at most {MAX_GAUSSIANS:,} are read")
    return [(count, 3, 3), (count,), (count, 3), (count, 3), (count, quat_bytes), (count, (degree + 1) ** 2 - 1, 3)]


def _read_gzip(packed: bytes) -> tuple[int, list[np.ndarray]]:
    """The number of bits behind the point, and all columns, of a file of version 2 or 3."""
    with gzip.GzipFile(fileobj=io.BytesIO(packed)) as file:
        magic, version, count, degree, fraction, _, _ = _HEADER.unpack(file.read(_HEADER.size))
        if magic != _MAGIC:
            raise ValueError("it has another beginning")
        _check_header(version, (2, 3), degree, fraction)
        return fraction, [_column(file, shape) for shape in _shapes(count, degree, 3 if version == 2 else 4)]


def _check_header(version: int, known: tuple[int, ...], degree: int, fraction: int) -> None:
    if version not in known:
        raise ValueError(f"it is of version {version}")
    if degree > 3 or fraction > _FIXED_BITS:
        raise ValueError("its header is damaged")


def _read_version_4(packed: bytes) -> tuple[int, list[np.ndarray]]:
    """The number of bits behind the point, and all columns, of a file of version 4."""
    import zstandard

    _, version, count, degree, fraction, _, streams = _HEADER.unpack_from(packed)
    (table,) = struct.unpack_from("<I", packed, _HEADER.size)
    _check_header(version, (4,), degree, fraction)
    shapes, columns = _shapes(count, degree), []
    if streams != sum(bool(np.prod(shape)) for shape in shapes) or table < _TABLE_AT:
        raise ValueError("its table is damaged")
    entry, at = table, table + streams * _ENTRY.size
    for shape in shapes:
        size = int(np.prod(shape))
        if not size:
            columns.append(np.zeros(shape, np.uint8))
            continue
        small, large = _ENTRY.unpack_from(packed, entry)
        part = packed[at : at + small]
        # The size is known, so a stream that would fill the memory is refused before it is unpacked.
        if large != size or len(part) < small or zstandard.frame_content_size(part) not in (size, -1):
            raise ValueError("it is truncated, or a column has another size")
        data = zstandard.ZstdDecompressor().decompress(part, max_output_size=size)
        if len(data) != size:
            raise ValueError("a column has another size")
        columns.append(np.frombuffer(data, np.uint8).reshape(shape))
        entry, at = entry + _ENTRY.size, at + small
    return fraction, columns


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _column(file: gzip.GzipFile, shape: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(shape))
    data = file.read(size)
    if len(data) < size:
        raise ValueError("it is truncated")
    return np.frombuffer(data, np.uint8).reshape(shape)


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


def _unpacked_first_three(packed: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of version 2, which has x, y and z of those whose w is not negative."""
    xyz = packed / 127.5 - 1
    return np.concatenate([np.sqrt(np.maximum(1 - (xyz**2).sum(1, keepdims=True), 0)), xyz], axis=1)


def _unpacked_quats(packed: np.ndarray) -> np.ndarray:
    word = np.ascontiguousarray(packed).view("<u4")[:, 0].astype(np.int64)
    largest, quats = word >> 30, np.zeros((len(word), 4))
    for component in (3, 2, 1, 0):
        stored = largest != component
        size = (word & _QUAT_STEPS) / _QUAT_STEPS / np.sqrt(2)
        quats[:, component] = np.where(stored, np.where(word & 512, -size, size), 0)
        word = np.where(stored, word >> 10, word)
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(1 - (quats**2).sum(1), 0))
    return quats[:, [3, 0, 1, 2]]


def write(path: Path, content: Content, options: SpzOptions) -> str:
    """Write the file, and return what is told of it."""
    write_spz(path, content.pose(), options.spz_version)
    return pose_words(path, content)
