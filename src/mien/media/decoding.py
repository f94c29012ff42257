"""Step 1: read picture files of users. No other module does. Their size is checked before memory is allocated.

A picture of 0.9 MB may unpack to 8.5 GB. Its first bytes announce its size. Only the five formats whose headers are
read here are decoded at all, whatever the file's name says.
"""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from mien.disk.reading import MAX_SIDE
from mien.errors import UserError
from mien.media.picture_files import png_fits

MAX_PICTURE_PIXELS = MAX_SIDE**2  # also the most that mien renders
_MAX_FILE_BYTES = 8 * MAX_PICTURE_PIXELS + (64 << 20)
"""Largest file in bytes: an uncompressed picture of that size with four 16-bit channels, and metadata."""
_MAX_SCANS = 200
"""Most scans of a JPEG. Cameras and editors write one to fourteen, and each costs a pass over the whole picture."""
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # markers between 0xC0 and 0xCF that start no JPEG frame
_TIFF_STARTS = (b"II\x2a\0", b"MM\0\x2a", b"II\x2b\0", b"MM\0\x2b")
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_TIFF_WIDTHS, _TIFF_HEIGHTS = (256, 322), (257, 323)  # TIFF tags of the picture's size and of its tiles' size


def decode_picture(path: Path, flags: int) -> np.ndarray | None:
    """Decode a picture file with OpenCV's `flags`. None if it is no picture, or a damaged one."""
    try:
        check_file_size(path)
        data = path.read_bytes() if path.is_file() else b""
    except OSError:
        return None
    announced = announced_size(data)
    if announced is None:
        return None
    width, height = announced
    if width * height > MAX_PICTURE_PIXELS:
        raise UserError(
            f"{path}: has {width}x{height} pixels, and a picture may have at most {MAX_PICTURE_PIXELS:,} "
            f"({MAX_SIDE}x{MAX_SIDE}); make it smaller"
        )
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def check_file_size(path: Path) -> None:
    """Check that a file is no larger than that of any picture, before it is read."""
    size = path.stat().st_size
    if size > _MAX_FILE_BYTES:
        raise UserError(
            f"{path}: has {size:,} bytes, and a picture may have at most {_MAX_FILE_BYTES:,}; make it smaller"
        )


def may_have_alpha(path: Path) -> bool:
    """Whether the header of a PNG, WebP or TIFF leaves room for alpha. Other pictures have none."""
    try:
        with path.open("rb") as file:
            data = file.read(4096)  # A PNG names its transparent colours here.
    except OSError:
        return False
    if data.startswith(b"\x89PNG"):
        return data[25:26] in (b"\4", b"\6") or b"tRNS" in data
    return data.startswith(_TIFF_STARTS) or data[8:16] in (b"WEBPVP8X", b"WEBPVP8L")


def announced_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that a picture announces; None for an unknown kind or a cut header."""
    for start, read in _READERS:
        if data.startswith(start):
            try:
                return read(data)
            except (struct.error, IndexError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int] | None:
    width, height = struct.unpack_from(">II", data, 16)
    return (width, height) if data[12:16] == b"IHDR" and png_fits(data) else None


def _bmp(data: bytes) -> tuple[int, int] | None:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)  # a negative height means rows from the top


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[8:16]
    if kind == b"WEBPVP8X":
        return (int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1)
    if kind == b"WEBPVP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"WEBPVP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _jpeg(data: bytes) -> tuple[int, int] | None:
    if data.count(b"\xff\xda") > _MAX_SCANS:
        return None
    place = 2
    while data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            place += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        place += 2 + struct.unpack_from(">H", data, place + 2)[0]
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """Read the first page. If a tag occurs twice, the larger value counts."""
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"\x2b\x00", b"\x00\x2b")
    (place,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, place)
    place += 8 if big else 2
    width, height = 0, 0
    for entry in range(min(count, 65535)):
        start = place + entry * (20 if big else 12)
        tag, kind = struct.unpack_from(order + "HH", data, start)
        if tag in (*_TIFF_WIDTHS, *_TIFF_HEIGHTS) and kind in _TIFF_TYPES:
            (value,) = struct.unpack_from(order + _TIFF_TYPES[kind], data, start + (12 if big else 8))
            width = max(width, value) if tag in _TIFF_WIDTHS else width
            height = max(height, value) if tag in _TIFF_HEIGHTS else height
    return (width, height) if width and height else None


_READERS: tuple[tuple[tuple[bytes, ...], Callable[[bytes], tuple[int, int] | None]], ...] = (
    ((b"\x89PNG\r\n\x1a\n",), _png),
    ((b"\xff\xd8",), _jpeg),
    ((b"BM",), _bmp),
    ((b"RIFF",), _webp),
    (_TIFF_STARTS, _tiff),
)
