"""Make faults in pictures: in sizes, lengths, types and order of the parts of PNG, JPEG, WebP, TIFF and BMP."""

import struct
import zlib
from collections.abc import Callable
from random import Random

from fuzzing.edges import packed_integer, put

Fault = Callable[[bytes, Random], tuple[str, bytes]]
_SIDES = (0, 1, 2, 31, 33, 255, 4096, 20_000, 65_535, 2**20, 2**31 - 1, 2**31, 2**32 - 1)


def faulty_picture(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one fault in a picture of any format."""
    for start, fault in _FORMATS.items():
        if data.startswith(start):
            return fault(data, dice)
    return "bytes", data[: dice.randrange(len(data) + 1)]


def chunks_of(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return the names and contents of a PNG's chunks."""
    found, at = [], 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def png_of(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """Return a PNG with these chunks and correct checksums."""
    parts = [
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def zeros(amount: int) -> bytes:
    """Return a zlib stream of this many zeros, a thousandth as long and quickly made. Its checksum is wrong."""
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)
    return b"\x78\x9c" + block * (amount >> 20) + b"\x03\x00" + bytes(4)


_EXTRA = (
    (b"tRNS", bytes(6)), (b"PLTE", bytes(range(255))), (b"gAMA", bytes(4)),
    (b"eXIf", b"MM\x00*\x00\x00\x00\x08" + b"\xff" * 40),
    (b"acTL", struct.pack(">II", 2**31 - 1, 0)), (b"iCCP", b"x\x00\x00" + zlib.compress(b"x" * 200)),
    (b"pHYs", b"\xff" * 9),
    (b"tEXt", b"Comment\x00\x1b]0;own\x07"), (b"zTXt", b"Comment\x00\x00" + zeros(64 << 20)), (b"sBIT", b"\xff" * 5),
    (b"IHDR", bytes(13)),
)  # fmt: skip


def _faulty_png(data: bytes, dice: Random) -> tuple[str, bytes]:
    chunks = chunks_of(data)
    kind = dice.choice(
        ("size", "size", "header", "header", "pixels", "pixels", "extra", "order", "length", "crc") * 3 + ("bomb",)
    )
    header = bytearray(chunks[0][1])
    if kind == "size":
        header[dice.choice((0, 4)) :][:4] = b""
        at = dice.choice((0, 4))
        header = bytearray(put(chunks[0][1], at, struct.pack(">I", dice.choice(_SIDES))))
    elif kind == "header":
        at = dice.randrange(8, 13)
        header[at] = dice.choice((0, 1, 2, 3, 4, 6, 7, 8, 16, 255))
    elif kind == "bomb":
        side = dice.choice((20_000, 30_000, 60_000))
        header = bytearray(struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
        chunks = [chunks[0], (b"IDAT", zeros(side * (side // 8 + 1) + (1 << 20))), chunks[-1]]
    chunks[0] = (chunks[0][0], bytes(header))
    middle = [index for index, (name, _) in enumerate(chunks) if name == b"IDAT"]
    if kind == "pixels":
        raw = zlib.decompress(b"".join(chunks[index][1] for index in middle))
        raw = dice.choice((raw[: len(raw) // 2], raw + raw, b"", bytes([dice.randrange(256)]) * len(raw), raw[1:]))
        chunks = [chunks[0], (b"IDAT", dice.choice((zlib.compress(raw), raw))), chunks[-1]]
    elif kind == "extra":
        chunks.insert(dice.randrange(len(chunks) + 1), dice.choice(_EXTRA))
    elif kind == "order":
        dice.shuffle(chunks)
        chunks = chunks[: dice.randrange(1, len(chunks) + 1)]
    whole = png_of(chunks)
    if kind == "length":
        return kind, put(whole, 8, packed_integer(dice, 4, "big"))
    if kind == "crc":
        return kind, put(whole, dice.randrange(8, len(whole)), dice.randbytes(4))
    return kind, whole


def _faulty_jpeg(data: bytes, dice: Random) -> tuple[str, bytes]:
    segments, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        segments.append(data[at : at + 2 + size])
        at += 2 + size
    rest = data[at:]
    kind = dice.choice(("size", "size", "frame", "length", "remove", "double", "order", "exif", "scan", "end"))
    frames = [index for index, segment in enumerate(segments) if segment[1] in (0xC0, 0xC1, 0xC2)]
    if kind in ("size", "frame") and frames:
        frame = segments[frames[0]]
        at = dice.choice((5, 7)) if kind == "size" else dice.choice((1, 4, 9, 10, 11, 12))
        field = (
            struct.pack(">H", dice.choice(_SIDES) % 65536)
            if kind == "size"
            else bytes([dice.choice((0, 1, 3, 4, 8, 12, 0xC2, 255))])
        )
        segments[frames[0]] = put(frame, at, field)
    elif kind == "length" and segments:
        index = dice.randrange(len(segments))
        segments[index] = put(segments[index], 2, packed_integer(dice, 2, "big"))
    elif kind == "remove" and segments:
        del segments[dice.randrange(len(segments))]
    elif kind == "double" and segments:
        segments += [dice.choice(segments)] * dice.choice((1, 200))
    elif kind == "order":
        dice.shuffle(segments)
    elif kind == "exif":
        entry = struct.pack(
            ">HHI", 0x0112, dice.choice((3, 4, 2, 99)), dice.choice((1, 0, 2**32 - 1))
        ) + packed_integer(dice, 4, "big")
        body = (
            b"Exif\x00\x00MM\x00*"
            + dice.choice((struct.pack(">I", 8), packed_integer(dice, 4, "big")))
            + struct.pack(">H", 1)
            + entry
        )
        segments.insert(0, b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body)
    elif kind == "scan":
        rest = put(rest, dice.randrange(len(rest)), dice.randbytes(8))
    elif kind == "end":
        rest = rest[: dice.randrange(len(rest))]
    return kind, data[:2] + b"".join(segments) + rest


def _faulty_fields(places: tuple[int, ...], sizes: tuple[int, ...]) -> Fault:
    """Make faults in little-endian fields at fixed places of a header, and in the bytes after it."""

    def faulty(data: bytes, dice: Random) -> tuple[str, bytes]:
        kind = dice.choice(("field", "field", "field", "field", "body", "end"))
        if kind == "field":
            for _ in range(dice.choice((1, 1, 2))):
                at = dice.choice(places)
                size = dice.choice(sizes)
                field = (
                    packed_integer(dice, size)
                    if dice.random() < 0.5
                    else (dice.choice(_SIDES) % (1 << 8 * size)).to_bytes(size, "little")
                )
                data = put(data, at, field)
            return kind, data
        if kind == "body":
            return kind, put(data, dice.randrange(len(data)), dice.randbytes(dice.choice((1, 4, 16))))
        return kind, data[: dice.randrange(len(data))]

    return faulty


def _faulty_tiff(data: bytes, dice: Random) -> tuple[str, bytes]:
    order = "little" if data[:2] == b"II" else "big"
    first = int.from_bytes(data[4:8], order)  # type: ignore[arg-type]
    count = int.from_bytes(data[first : first + 2], order)  # type: ignore[arg-type]
    kind = dice.choice(("entry", "entry", "entry", "tag", "directory", "body", "end"))
    at = first + 2 + 12 * dice.randrange(max(1, count))
    if kind == "entry":
        offset, size = dice.choice(((2, 2), (4, 4), (8, 4), (8, 4), (8, 2)))
        return kind, put(data, at + offset, packed_integer(dice, size, order))
    if kind == "tag":
        tag = dice.choice(
            (256, 257, 258, 259, 262, 273, 277, 278, 279, 284, 320, 322, 323, 324, 325, 330, 339, 347, 34675, 65535)
        )
        return kind, put(data, at, tag.to_bytes(2, order))  # type: ignore[arg-type]
    if kind == "directory":
        return kind, put(data, dice.choice((2, 4, first, first + 2 + 12 * count)), packed_integer(dice, 4, order))
    if kind == "body":
        return kind, put(data, dice.randrange(len(data)), dice.randbytes(8))
    return kind, data[: dice.randrange(len(data))]


_FORMATS: dict[bytes, Fault] = {
    b"\x89PNG": _faulty_png,
    b"\xff\xd8": _faulty_jpeg,
    b"RIFF": _faulty_fields((4, 12, 16, 20, 23, 24, 26, 27, 28, 30), (1, 2, 3, 4)),
    b"BM": _faulty_fields((2, 10, 14, 18, 22, 26, 28, 30, 34, 46, 50), (2, 4)),
    b"II": _faulty_tiff,
    b"MM": _faulty_tiff,
}
