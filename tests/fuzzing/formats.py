"""Make faults by the format of a file, also behind its checksums and its compression."""

import gzip
import io
import json
import pickletools
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import safetensors.numpy

from damage import flip_or_cut
from fuzzing import kinds
from fuzzing.kinds import INTEGERS, SMALL_PICKLES, edge_number, packed_integer, put
from fuzzing.repairs import joined, repair_glb, repair_portable, repair_tensors, split, with_checksum

Fault = Callable[[bytes, Random], tuple[str, bytes]]


def faulty_json(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in a json file: in its text, or in its values with a checksum that is mostly correct."""
    if dice.random() < 0.15:
        return kinds.faulty_text(data, dice)
    content = json.loads(data)
    checksum = content.pop("checksum", None) if isinstance(content, dict) else None
    frame = {}
    if isinstance(content, dict) and dice.random() < 0.8:
        frame = {name: content.pop(name) for name in ("format", "version") if name in content}
    kind, content = kinds.faulty_value(content, dice)
    if isinstance(content, dict):
        content = {**frame, **content}
        chance = dice.random()
        if checksum is not None and chance < 0.75:
            content = with_checksum(content)
        elif checksum is not None and chance > 0.9:
            content["checksum"] = checksum
    return kind, kinds.written(content, dice)


def faulty_lines(data: bytes, dice: Random) -> tuple[str, bytes]:
    lines = data.splitlines()
    index = dice.choice((dice.randrange(len(lines)), len(lines) - 1, len(lines) - 1))
    kind, lines[index] = faulty_json(lines[index], dice)
    lines[index] = lines[index].replace(b"\n", b" ")
    lines += [lines[index]] * dice.choice((0, 0, 0, 1, 1000))
    return kind, b"\n".join(lines) + dice.choice((b"\n", b"\n", b""))


def faulty_members(
    members: dict[str, Any], dice: Random, fault: Callable[[str, Any], tuple[str, Any]]
) -> tuple[str, dict[str, Any]]:
    """Make a fault in a member, in its name, or in the list of them."""
    name, kind = dice.choice(list(members)), dice.choice(("member",) * 8 + ("list", "name"))
    if kind == "list":
        return kind, dict(zip(members, kinds.faulty_list(list(members.values()), dice), strict=False))
    if kind == "name":
        odd = ("../x", "/x", f"{name}.npy", f"{name}s", "", "a\x1b[31m", "f" * 10_000, "__metadata", *members)
        return kind, {**{key: one for key, one in members.items() if key != name}, dice.choice(odd): members[name]}
    told, changed = fault(name, members[name])
    return f"{name[:20]} {told}", {**members, name: changed}


def faulty_tensors(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one fault in a safetensors file. Checksums are not repaired here."""
    kind = dice.choice(("arrays",) * 11 + ("header",) * 4 + ("length",))
    header, body = split(data)
    if kind == "arrays":
        arrays = dict(sorted(safetensors.numpy.load(data).items()))  # in a fixed order
        kind, arrays = faulty_members(arrays, dice, lambda name, array: kinds.faulty_array(array, dice))
        kept = {"__metadata__": header["__metadata__"]} if "__metadata__" in header else {}
        header, body = split(safetensors.numpy.save(arrays))
        return kind, joined({**kept, **header}, body)
    if kind == "header":
        told, header = kinds.faulty_value(header, dice)
        return f"header {told}", joined(kinds.written(header, dice), body)
    length = dice.choice((*INTEGERS[:20], len(data), len(data) - 8, len(data) - 7)) % 2**64
    return kind, length.to_bytes(8, "little") + data[8:]


def faulty_repaired_tensors(data: bytes, dice: Random) -> tuple[str, bytes]:
    kind, data = faulty_tensors(data, dice)
    return kind, repair_tensors(data)


def faulty_portable(data: bytes, dice: Random) -> tuple[str, bytes]:
    if dice.random() < 0.5:
        kind, data = faulty_tensors(data, dice)
        return kind, repair_portable(data)
    kind, content = kinds.faulty_value(json.loads(split(data)[0]["__metadata__"]["mien"])["content"], dice)
    return f"content {kind}", repair_portable(data, content)


def faulty_npy(data: bytes, dice: Random) -> tuple[str, bytes]:
    if dice.random() < 0.6:
        kind, array = kinds.faulty_array(np.load(io.BytesIO(data)), dice)
        return kind, npy_of(array)
    size = int.from_bytes(data[8:10], "little")
    odd = ("", "{", "__import__('os')", "(" * 5000, "{'descr': 1}", "1" * 5000)
    types = ("|O", "<f8", ">f4", "<U1000", "<c16", "[('a', '<f4')]", "<M8[s]", "x")
    shapes = (*((one,) for one in INTEGERS[:23]), (), (-1,), (1.5,), "x", (1,) * 40, (5_000_000_000, 3))
    made = f"{{'descr': {dice.choice(types)!r}, 'fortran_order': False, 'shape': {dice.choice(shapes)!r}, }}"
    _, text = dice.choice(
        (("", dice.choice(odd).encode()), ("", made.encode()), kinds.faulty_text(data[10 : 10 + size], dice))
    )
    text = text[:65_000]
    return "header", npy_head(text) + data[10 + size :]


def npy_head(text: bytes) -> bytes:
    """Return what stands before the numbers of a .npy file."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text + b"\n"


def npy_of(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def zeros(amount: int) -> bytes:
    """Return a raw deflate stream of this many zeros, a thousandth as long and quickly made."""
    pack = zlib.compressobj(9, zlib.DEFLATED, -15)
    return (pack.compress(bytes(1 << 20)) + pack.flush(zlib.Z_FULL_FLUSH)) * (amount >> 20) + b"\x03\x00"


def members_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def zip_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return a zip archive with these members, with the same bytes every time."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def bomb_of(name: str, amount: int, head: bytes = b"") -> bytes:
    """Return a small zip archive whose only member unpacks to many zeros after `head`."""
    packed = zlib.compressobj(1, zlib.DEFLATED, -15)
    body = packed.compress(head) + packed.flush(zlib.Z_FULL_FLUSH) + zeros(amount)
    sizes = struct.pack("<HHHIII", 8, 0, 33, 0, len(body), min(amount + len(head), 2**32 - 1))
    whole = zip_of({name: b""})
    directory, end = whole.rfind(b"PK\x01\x02"), whole.rfind(b"PK\x05\x06")
    local = put(whole[:directory], 8, sizes) + body
    return local + put(whole[directory:end], 10, sizes) + put(whole[end:], 16, struct.pack("<I", len(local)))


def faulty_zip(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in a member of an archive by its own kind, or in the archive around it."""

    def fault(name: str, content: bytes) -> tuple[str, bytes]:
        return FORMATS.get(Path(name).suffix, kinds.faulty_bytes)(content, dice)

    members, kind = members_of(data), dice.choice(("members",) * 9 + ("bytes", "bytes", "method", "bomb"))
    if kind == "members":
        kind, members = faulty_members(members, dice, fault)
        return kind, zip_of(members)
    if kind == "bomb":
        name, amount = dice.choice(list(members)), dice.choice((1 << 30, 3 << 30, 6 << 30))
        head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({amount // 12}, 3), }}"
        return kind, bomb_of(name, amount, npy_head(head.encode()) if name.endswith(".npy") else b"")
    if kind == "method":
        return kind, zip_of(members, dice.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2)))
    return kind, kinds.faulty_bytes(zip_of(members), dice, 150)[1]


def _gzip_of_zeros(head: bytes, amount: int) -> bytes:
    """Return a gzip file of some bytes and many zeros, which are its second and further members."""
    member = gzip.compress(bytes(1 << 24), 9, mtime=0)
    return gzip.compress(head, 9, mtime=0) + member * -(-amount // (1 << 24))


def _faulty_header(content: Any, body: bytes, dice: Random) -> tuple[str, bytes, bytes]:
    """Make a fault in a json header, mostly in some of its larger parts, or in the numbers after it."""
    kind = dice.choice(("value",) * 6 + ("numbers", "cut", "text"))
    if kind == "numbers":
        for _ in range(dice.choice((1, 30))):
            number = kinds.edge_for(np.dtype("<f4"), dice).tobytes()
            body = put(body, 4 * dice.randrange(len(body) // 4), number)
    elif kind == "cut":
        body = dice.choice((body[: dice.randrange(len(body))], b"\xff" * len(body), body + body))
    elif kind == "text":
        return kind, kinds.faulty_text(json.dumps(content).encode(), dice)[1], body
    else:
        large = [place for place in kinds.entries(content) if isinstance(place[0][place[1]], (dict, list))]
        container, key = dice.choice([({"": content}, ""), *large[:200]])
        kind, container[key] = kinds.faulty_value(container[key], dice)
        content = container[key] if key == "" else content
    return kind, kinds.written(content, dice), body


def faulty_packed(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the header or the arrays of a .packed file, or in the gzip around them."""
    plain = gzip.decompress(data)
    length = int.from_bytes(plain[:4], "little")
    kind, text, arrays = _faulty_header(json.loads(plain[4 : 4 + length]), plain[4 + length :], dice)
    text += b" " * (-(4 + len(text)) % 4)
    kind = dice.choice((kind,) * 9 + ("length", "bomb", "gzip"))
    size = packed_integer(dice, 4) if kind == "length" else struct.pack("<I", len(text))
    if kind == "bomb":
        return kind, _gzip_of_zeros(size + text + arrays, dice.choice((1 << 28, 3 << 30)))
    packed = gzip.compress(size + text + arrays, 1, mtime=0)
    return kind, flip_or_cut(packed, dice) if kind == "gzip" else packed


def faulty_glb(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the json of a .glb, in its buffer, or in the lengths around them."""
    length = int.from_bytes(data[12:16], "little")
    kind, text, buffer = _faulty_header(json.loads(data[20 : 20 + length]), data[28 + length :], dice)
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(buffer), len(text), 0x4E4F534A)
    whole = head + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    if dice.random() < 0.1:
        return "frame", put(whole, dice.choice((0, 4, 8, 12, 16, 20 + len(text))), packed_integer(dice, 4))
    return kind, repair_glb(whole)


def png_of(chunks: Sequence[tuple[bytes, bytes]]) -> bytes:
    parts = [struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
             for name, body in chunks]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


_SIDES = (0, 1, 2, 31, 33, 255, 4096, 20_000, 65_535, 2**20, 2**31 - 1, 2**31, 2**32 - 1)
_CHUNKS = (
    (b"tRNS", bytes(6)), (b"PLTE", bytes(range(255))), (b"eXIf", b"MM\x00*\x00\x00\x00\x08" + b"\xff" * 40),
    (b"acTL", struct.pack(">II", 2**31 - 1, 0)), (b"iCCP", b"x\x00\x00" + zlib.compress(b"x" * 200)),
    (b"tEXt", b"Comment\x00\x1b]0;own\x07"), (b"zTXt", b"Comment\x00\x00\x78\x9c" + zeros(64 << 20)),
    (b"IHDR", bytes(13)),
)  # fmt: skip


def faulty_png(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in a PNG with correct checksums, or anywhere in its bytes."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    (_, head), *others = chunks
    raw = zlib.decompress(b"".join(body for name, body in chunks if name == b"IDAT"))
    lines = (raw[: len(raw) // 2], raw + raw, b"", bytes([dice.randrange(256)]) * len(raw), raw[1:])
    at, side = dice.randrange(len(chunks) + 1), dice.choice((20_000, 30_000, 60_000))
    changes: dict[str, Callable[[], list[tuple[bytes, bytes]]]] = {
        "size": lambda: [(b"IHDR", put(head, dice.choice((0, 4)), struct.pack(">I", dice.choice(_SIDES)))), *others],
        "header": lambda: [
            (b"IHDR", put(head, dice.randrange(8, 13), bytes([dice.choice((0, 1, 2, 3, 6, 7, 16, 255))]))), *others],
        "pixels": lambda: [chunks[0], (b"IDAT", dice.choice((zlib.compress, bytes))(dice.choice(lines))), chunks[-1]],
        "extra": lambda: [*chunks[:at], dice.choice(_CHUNKS), *chunks[at:]],
        "list": lambda: kinds.faulty_list(chunks, dice),
        "bomb": lambda: [
            (b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)),
            (b"IDAT", b"\x78\x9c" + zeros(side * (side // 8 + 1) + (1 << 20)) + bytes(4)), chunks[-1]],
    }  # fmt: skip
    kind = dice.choice(("size", "header", "pixels", "extra", "list", "bytes") * 3 + ("bomb",))
    return kind, png_of(changes[kind]()) if kind in changes else kinds.faulty_bytes(data, dice)[1]


_OPERATIONS = (*(bytes([one]) for one in b"(]}NtRb.02Q\x93\x81oeua"), b"cos\nsystem\n", b"cbuiltins\neval\n",
               b"cmien.cli\nmain\n", b"c\n\n", b"cnumpy\nndarray\n", b"c" + b"x" * 9999 + b"\n\x1b[31m\n")  # fmt: skip


def faulty_pickle(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make faults in the operations of a pickle, or return a small pickle that asks for much memory."""
    kind = dice.choice(("list", "list", "argument", "argument", "insert", "insert", "small", "cut"))
    if kind == "small":
        return kind, dice.choice(list(SMALL_PICKLES.values()))
    starts = [position for _, _, position in pickletools.genops(data) if position is not None]
    operations = [data[start:end] for start, end in zip(starts, [*starts[1:], len(data)], strict=True)]
    for _ in range(dice.choice((1, 1, 3))):
        index = dice.randrange(len(operations))
        one = operations[index]
        if kind == "list":
            operations = kinds.faulty_list(operations, dice) or operations
        elif kind == "insert":
            operations[index : index + dice.randrange(2)] = [dice.choice(_OPERATIONS)]
        elif kind == "argument" and len(one) > 1:
            operations[index] = one[:1] + packed_integer(dice, min(len(one) - 1, 8)) + one[9:]
    whole = b"".join(operations)
    return kind, whole[: dice.randrange(len(whole))] if kind == "cut" else whole


def faulty_ply(data: bytes, dice: Random) -> tuple[str, bytes]:
    head, mark, body = re.split(rb"(end_header(?:\r\n|\r|\n))", data, maxsplit=1)
    if dice.random() < 0.6:
        numbers = " ".join(str(edge_number(dice)) for _ in range(dice.choice((0, 1, 16, 17, 10_000))))
        lines = (f"comment mien frame {numbers}", f"comment T_world_local {numbers}", "property list uchar int x",
                 "property double x", "element face 9", f"element vertex {edge_number(dice)}", "format ascii 1.0",
                 "format binary_big_endian 1.0", *head.decode("latin1").splitlines())  # fmt: skip
        kind, head = kinds.faulty_text(head, dice, lines)
    else:
        kind, _, body = _faulty_header({}, body, dice)
    return kind, head + dice.choice((mark,) * 9 + (b"", b"end_header\r\n", b"x" * 1_000_000)) + body


FORMATS: dict[str, Fault] = {
    ".json": faulty_json, ".partial": faulty_lines, ".csv": kinds.faulty_text, ".ply": faulty_ply, ".npy": faulty_npy,
    ".safetensors": faulty_repaired_tensors, ".mien": faulty_portable,
    **dict.fromkeys((".npz", ".frame"), faulty_zip), ".packed": faulty_packed, ".glb": faulty_glb, ".png": faulty_png,
    ".pkl": faulty_pickle,
}  # fmt: skip
"""Faults by the ending of a file; others get faults of their bytes."""
