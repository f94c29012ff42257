"""Make faults in videos: in the boxes of mp4 and mov, and in the bytes of other containers."""

import struct
from random import Random

from fuzzing.edges import edge_integer, packed_integer, put

_HOLDERS = frozenset({b"moov", b"trak", b"mdia", b"minf", b"stbl", b"udta", b"edts", b"dinf"})
_TABLES = frozenset({b"stts", b"stsc", b"stsz", b"stco", b"co64", b"stss", b"ctts", b"elst", b"stsd"})
_CODECS = (
    b"xxxx",
    b"hvc1",
    b"av01",
    b"mp4v",
    b"vp09",
    b"rle ",
    b"raw ",
    b"jpeg",
    b"\x00\x00\x00\x00",
    b"\xa9\x1b[m",
    b"apcn",
    b"dvh1",
)
Box = tuple[bytes, int, int]
"""Type of a box, offset of its size field, and its whole size."""


def boxes_of(data: bytes, start: int = 0, end: int | None = None) -> list[Box]:
    """Return all boxes in order, including those within others."""
    found, end = [], len(data) if end is None else end
    while start + 8 <= end:
        size, kind = struct.unpack(">I4s", data[start : start + 8])
        size = size if 8 <= size <= end - start else end - start
        found.append((kind, start, size))
        if kind in _HOLDERS:
            found += boxes_of(data, start + 8, start + size)
        start += size
    return found


def faulty_mp4(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one to three faults in the boxes of an mp4 or mov."""
    kind = dice.choice(
        (
            "field",
            "field",
            "field",
            "table",
            "table",
            "size",
            "type",
            "remove",
            "double",
            "codec",
            "extradata",
            "tag",
            "frames",
            "cut",
        )
    )
    for _ in range(dice.choice((1, 1, 2, 3))):
        found = [box for box in boxes_of(data) if box[0] != b"mdat"]
        if not found:
            break
        data = _with_fault(data, kind, found, dice)
    return kind, data


def _with_fault(data: bytes, kind: str, found: list[Box], dice: Random) -> bytes:
    name, start, size = dice.choice(found)
    if kind in ("field", "table", "codec", "extradata"):
        wanted = {"table": _TABLES, "codec": {b"stsd"}, "extradata": {b"stsd"}}.get(kind)
        if wanted:
            name, start, size = dice.choice([box for box in found if box[0] in wanted] or found)
        if kind == "codec":
            return put(data, start + 20, dice.choice(_CODECS))
        if kind == "extradata":
            return put(data, start + dice.randrange(min(100, size - 1), size), dice.randbytes(3))
        at = start + 8 + 4 * dice.randrange(max(1, min(size - 8, 96) // 4))
        return put(data, at, packed_integer(dice, dice.choice((1, 2, 4, 4, 4, 8)), "big"))[: len(data)]
    if kind == "size":
        return put(data, start, packed_integer(dice, 4, "big"))
    if kind == "type":
        return put(
            data,
            start + 4,
            dice.choice((b"free", b"moov", b"mdat", b"meta", b"\x00\x00\x00\x00", dice.choice(found)[0])),
        )
    if kind == "remove":
        return data[:start] + data[start + size :]
    if kind == "double":
        return data[: start + size] + data[start : start + size] * dice.choice((1, 30)) + data[start + size :]
    if kind == "tag":
        return with_tag(
            data,
            dice.choice((b"gr\xf6\xdfer \xff", b"\x1b]0;own\x07", b"x" * 70_000, b"\x00" * 20, "größer".encode())),
            dice,
        )
    if kind == "frames":
        middle = [box for box in boxes_of(data) if box[0] == b"mdat"]
        if not middle:
            return data
        at = middle[0][1] + dice.randrange(8, max(9, middle[0][2]))
        return put(data, at, packed_integer(dice, 4, "big") if dice.random() < 0.5 else dice.randbytes(16))[: len(data)]
    return data[: dice.randrange(len(data))]


def with_tag(data: bytes, text: bytes, dice: Random) -> bytes:
    """Add a title at the end of the moov box, as telephones write it."""
    text = text[:65_000]
    title = struct.pack(">I4sHH", 12 + len(text), b"\xa9nam", len(text), dice.choice((0, 0x15C7, 0x55C4))) + text
    moov = next((box for box in boxes_of(data) if box[0] == b"moov"), None)
    if moov is None:
        return data
    tags = struct.pack(">I4s", 8 + len(title), b"udta") + title
    _, start, size = moov
    grown = put(data, start, struct.pack(">I", size + len(tags)))
    return grown[: start + size] + tags + grown[start + size :]


def faulty_stream(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make faults in the first bytes, where a container says what it holds, or in later ones."""
    kind = dice.choice(("head", "head", "head", "field", "field", "middle", "cut", "double", "remove"))
    for _ in range(dice.choice((1, 1, 3))):
        at = dice.randrange(max(1, len(data) if kind in ("middle", "double", "remove") else min(len(data), 512)))
        if kind == "head":
            data = put(data, at, bytes([edge_integer(dice) % 256]))[: len(data)]
        elif kind == "field":
            data = put(data, at, packed_integer(dice, dice.choice((2, 4, 8)), dice.choice(("big", "little"))))[
                : len(data)
            ]
        elif kind == "middle":
            data = put(data, at, dice.randbytes(8))[: len(data)]
        elif kind == "double":
            data = data[:at] + data[max(0, at - 2000) : at] * 2 + data[at:]
        elif kind == "remove":
            data = data[:at] + data[at + dice.choice((1, 100, 5000)) :]
    return kind, data[: dice.randrange(len(data) + 1)] if kind == "cut" else data
