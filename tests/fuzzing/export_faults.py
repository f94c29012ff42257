"""Make faults in exported files: .glb, .spz, .sog, USD and .packed, also behind their checksums and compression."""

import gzip
import io
import json
import re
import struct
import zipfile
from random import Random
from typing import Any

from damage import flip_or_cut
from fuzzing.archive_faults import with_bomb, zip_of
from fuzzing.box_faults import faulty_stream
from fuzzing.edges import FLOATS, TEXTS, edge_number, packed_integer, put
from fuzzing.json_faults import faulty_json, faulty_text, written
from fuzzing.picture_faults import faulty_picture, zeros
from fuzzing.repairs import repair_glb

_MEMBER_KINDS = ("member",) * 6 + ("remove", "name", "zip", "zip", "method", "bomb")
_GAUSSIAN_BYTES = 19
"""Bytes of a Gaussian in a .spz, without coefficients of higher degrees."""


def faulty_glb(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the json of a .glb, in its buffer, or in the lengths around them."""
    length = int.from_bytes(data[12:16], "little")
    content, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
    kind = dice.choice(("json", "tensors", "avatar", "views", "numbers", "share", "text", "frame"))
    parts = {
        "tensors": content["extensions"]["MIEN_gaussian_avatar"],
        "avatar": content["extensions"]["MIEN_gaussian_avatar"]["avatar"],
    }
    text = b""
    if kind == "json":
        told, content = faulty_json(content, dice)
        kind = f"json {told}"
    elif kind in parts:
        name = "content" if kind == "avatar" else "tensors"
        told, parts[kind][name] = faulty_json(parts[kind][name], dice)
        kind = f"{kind} {told}"
    elif kind == "views":
        name = dice.choice(("accessors", "bufferViews"))
        told, content[name] = faulty_json(content[name], dice)
        kind = f"{name} {told}"
    elif kind == "share":
        tensors = parts["tensors"]["tensors"]
        chosen = dice.choice(list(tensors.values()))
        tensors |= {f"x{index}": chosen for index in range(dice.choice((1, 3000)))}
    elif kind == "numbers":
        for _ in range(dice.choice((1, 30))):
            value = struct.pack("<f", _as_float(dice.choice(FLOATS)))
            buffer = put(buffer, 4 * dice.randrange(len(buffer) // 4), value)
    elif kind == "text":
        told, text = faulty_text(json.dumps(content).encode(), dice)
        kind = f"text {told}"
    text = text or written(content, dice)
    text += b" " * (-len(text) % 4)
    size = 28 + len(text) + len(buffer)
    head = struct.pack("<IIIII", 0x46546C67, 2, size, len(text), 0x4E4F534A)
    whole = head + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    if kind == "frame":
        at = dice.choice((0, 4, 8, 12, 16, 20 + len(text), 24 + len(text)))
        return kind, put(whole, at, packed_integer(dice, 4))
    return kind, repair_glb(whole)


def _as_float(value: float) -> float:
    return value if abs(value) < 3.4e38 or value != value else float("inf")


def faulty_spz(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the header or the columns of a .spz, or in the gzip around them."""
    plain = gzip.decompress(data)
    kind = dice.choice(("header", "header", "header", "claim", "columns", "cut", "more", "bomb", "gzip", "members"))
    if kind == "header":
        at, size = dice.choice(((0, 4), (4, 4), (8, 4), (8, 4), (12, 1), (13, 1), (14, 1), (15, 1)))
        plain = put(plain, at, packed_integer(dice, size))
    elif kind == "claim":  # as many Gaussians as it says, all of them zero
        count, degree = dice.choice((100_000, 2_000_000, 2_000_001)), dice.randrange(5)
        head = put(put(plain[:16], 8, count.to_bytes(4, "little")), 12, bytes([degree]))
        amount = count * (_GAUSSIAN_BYTES + 1 + 3 * ((degree + 1) ** 2 - 1))
        return f"claim {count}", _gzip_of_zeros(head, amount)
    elif kind == "columns":
        plain = put(plain, dice.randrange(16, len(plain)), dice.randbytes(dice.choice((1, 30))))[: len(plain)]
    elif kind == "cut":
        plain = plain[: dice.randrange(len(plain))]
    elif kind == "more":
        plain += bytes(dice.choice((1, 1 << 20)))
    elif kind == "bomb":
        return kind, _gzip_of_zeros(plain, dice.choice((1 << 30, 6 << 30)))
    elif kind == "gzip":
        return kind, put(data, dice.randrange(min(len(data), 30)), dice.randbytes(dice.choice((1, 4))))
    packed = gzip.compress(plain, 1, mtime=0)
    return kind, packed * dice.choice((2, 1000)) if kind == "members" else packed


def _gzip_of_zeros(head: bytes, amount: int) -> bytes:
    """Return a gzip file of some bytes and many zeros, which are its second and further members."""
    member = gzip.compress(bytes(1 << 24), 9, mtime=0)
    return gzip.compress(head, 9, mtime=0) + member * -(-amount // (1 << 24))


def faulty_sog(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in meta.json or a picture of a .sog, or in the zip around them."""
    return _faulty_zip(data, dice, _faulty_sog_member)


def _faulty_sog_member(name: str, content: bytes, dice: Random) -> tuple[str, bytes]:
    if not name.endswith(".json"):
        return faulty_picture(content, dice)
    if dice.random() < 0.2:
        return faulty_text(content, dice)
    kind, changed = faulty_json(json.loads(content), dice)
    return kind, written(changed, dice)


def faulty_usda(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the text of a USD stage: a number, a word, a line, or a name of another file."""
    text = data.decode()
    kind = dice.choice(("number", "number", "word", "line", "list", "insert", "insert", "text", "deep"))
    lines = text.splitlines()
    row = dice.randrange(1, len(lines))
    if kind == "number":
        found = list(re.finditer(r"-?[0-9][0-9.e+-]*", text))
        for place in sorted(dice.sample(found, min(len(found), dice.choice((1, 1, 20)))), key=lambda one: -one.start()):
            value = dice.choice(("inf", "-inf", "nan", "1e400", "9" * 400, str(edge_number(dice)), "x"))
            text = text[: place.start()] + value + text[place.end() :]
        return kind, text.encode()
    if kind == "word":
        words = sorted(set(re.findall(r"[A-Za-z_][A-Za-z0-9_:]+", text)))
        return kind, text.replace(dice.choice(words), dice.choice((*words, *TEXTS)), dice.choice((1, -1))).encode(
            "utf-8", "surrogatepass"
        )
    if kind == "line":
        lines = dice.choice((lines[:row] + lines[row + 1 :], lines[:row] + lines[row : row + 1] * 300 + lines[row:]))
    elif kind == "list":
        start = text.find("[", dice.randrange(len(text)))
        end = text.find("]", start)
        inner = dice.choice(("", text[start + 1 : end] + ", " + text[start + 1 : end], "(1, 2, 3)", "1", "None"))
        return kind, (text[: start + 1] + inner + text[end:]).encode()
    elif kind == "insert":
        lines.insert(row, dice.choice(_USD_LINES).replace("{name}", dice.choice(("other.usda", "@CANARY@/x.usda"))))
    elif kind == "text":
        return faulty_text(data, dice)
    elif kind == "deep":
        depth = dice.choice((100, 5000))
        lines += [f'def "a{index}" {{' for index in range(depth)] + ["}"] * depth
    return kind, "\n".join([*lines, ""]).encode()


_USD_LINES = (
    "subLayers = [@{name}@]",
    "references = @{name}@",
    "payload = @{name}@",
    'def "a" ( references = @{name}@ ) {}',
    "asset file = @{name}@",
    "point3f[] positions.timeSamples = { 0: [(1, 2, 3)] }",
    "point3f[] positions.connect = </avatar.x>",
    "float[] opacities = [inf]",
    'variants = { string v = "x" }',
    "matrix4d xformOp:transform = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,nan))",
    'string secret = "' + "x" * 100_000 + '"',
)


def faulty_usdc(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make faults in the bytes of a binary stage: in its first ones, its table of contents, or anywhere."""
    if dice.random() < 0.5:
        return faulty_stream(data, dice)
    contents = int.from_bytes(data[16:24], "little")
    kind = dice.choice(("contents", "contents", "bit"))
    if kind == "contents":
        at = dice.choice((16, contents + 8 * dice.randrange(max(1, (len(data) - contents) // 8))))
        return kind, put(data, at, packed_integer(dice, 8))[: len(data)]
    return kind, flip_or_cut(data, dice)


def faulty_usdz(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the stage of a package, or in the zip around it."""
    return _faulty_zip(data, dice, lambda name, content, dice: faulty_usdc(content, dice))


def _faulty_zip(data: bytes, dice: Random, faulty_member: Any) -> tuple[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name, kind = dice.choice(list(members)), dice.choice(_MEMBER_KINDS)
    if kind == "member":
        told, members[name] = faulty_member(name, members[name], dice)
        kind = f"{name[:20]} {told}"
    elif kind == "remove":
        members = {other: content for other, content in members.items() if other != name}
    elif kind == "name":
        other = dice.choice(("../x", "/x", "", "a\x1b[31m", "f" * 5000, *members))
        members = {other if key == name else key: content for key, content in members.items()}
    elif kind == "bomb":
        return kind, with_bomb(members, name, b"", dice.choice((1 << 30, 6 << 30)))
    method = dice.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2)) if kind == "method" else zipfile.ZIP_STORED
    whole = zip_of(members, method)
    if kind == "zip":
        at = dice.choice((whole.rfind(b"PK\x01\x02"), whole.rfind(b"PK\x05\x06"), 0))
        return kind, put(whole, max(at, 0) + dice.randrange(4, 30), packed_integer(dice, dice.choice((1, 2, 4))))
    return kind, whole


def faulty_packed(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the header or the arrays of a .packed file, or in the gzip around them."""
    plain = gzip.decompress(data)
    length = int.from_bytes(plain[:4], "little")
    header, arrays = json.loads(plain[4 : 4 + length]), plain[4 + length :]
    kind = dice.choice(("header", "tensors", "tensors", "content", "arrays", "length", "share", "text", "bomb", "gzip"))
    text = b""
    if kind == "header":
        told, header = faulty_json(header, dice)
        kind = f"header {told}"
    elif kind in ("tensors", "content"):
        told, header[kind] = faulty_json(header[kind], dice)
        kind = f"{kind} {told}"
    elif kind == "arrays":
        place = dice.randrange(len(arrays))
        arrays = dice.choice((arrays[:place], put(arrays, place, dice.randbytes(30))[: len(arrays)], b"\xff" * place))
    elif kind == "share":
        chosen = dice.choice(list(header["tensors"].values()))
        header["tensors"] |= {f"x{index}": chosen for index in range(3000)}
        header["content"]["more"] = [{"tensor": f"x{index}"} for index in range(3000)]
    elif kind == "text":
        told, text = faulty_text(json.dumps(header).encode(), dice)
        kind = f"text {told}"
    text = text or written(header, dice)
    text += b" " * (-(4 + len(text)) % 4)
    size = packed_integer(dice, 4) if kind == "length" else struct.pack("<I", len(text))
    if kind == "bomb":
        return kind, _gzip_of_zeros(size + text + arrays, dice.choice((1 << 28, 3 << 30)))
    packed = gzip.compress(size + text + arrays, 1, mtime=0)
    if kind == "gzip":
        return kind, flip_or_cut(packed, dice)
    return kind, packed


def faulty_sound(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make faults in the fields of a .wav, or in the frames of a stream such as .mp3."""
    if not data.startswith(b"RIFF") or dice.random() < 0.2:
        return faulty_stream(data, dice)
    kind = dice.choice(("field", "field", "field", "chunk", "double", "samples"))
    if kind == "field":
        at, size = dice.choice(((4, 4), (16, 4), (20, 2), (22, 2), (24, 4), (28, 4), (32, 2), (34, 2), (40, 4)))
        return kind, put(data, at, packed_integer(dice, size))
    if kind == "chunk":
        body = dice.choice((b"", bytes(9), b"\x1b]0;own\x07", zeros(1 << 20)[:5000]))
        extra = dice.choice((b"LIST", b"fmt ", b"data", b"id3 ", b"\x00\x00\x00\x00")) + packed_integer(dice, 4) + body
        at = dice.choice((12, 36, len(data)))
        return kind, data[:at] + extra + data[at:]
    if kind == "double":
        return kind, data + data[dice.choice((0, 12, 36)) :]
    return kind, put(data, 44 + dice.randrange(len(data) - 44), dice.randbytes(200))[: len(data)]


EXPORT_FAULTS = {
    ".glb": faulty_glb, ".spz": faulty_spz, ".sog": faulty_sog, ".packed": faulty_packed, ".usd": faulty_usdc,
    ".usda": faulty_usda, ".usdc": faulty_usdc, ".usdz": faulty_usdz, ".wav": faulty_sound, ".mp3": faulty_sound,
    ".flac": faulty_sound, ".ogg": faulty_sound,
}  # fmt: skip
"""Faults by the ending of the file."""
