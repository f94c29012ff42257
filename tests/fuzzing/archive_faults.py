"""Make faults in .npz and .pkl files: in arrays, in the headers of members, and in the operations of a pickle."""

import io
import pickletools
import re
import struct
import zipfile
import zlib
from random import Random
from typing import Any

import numpy as np

from fuzzing.edges import INTEGERS, edge_integer, packed_integer, put
from fuzzing.picture_faults import zeros
from fuzzing.tensor_faults import faulty_arrays, faulty_numbers

_TYPES = (
    "'|O'",
    "'<f8'",
    "'>f4'",
    "'<U1000'",
    "'|S5'",
    "'<c16'",
    "[('a', '<f4')]",
    "'<M8[s]'",
    "'|V8'",
    "'x'",
    "None",
    "'|b1'",
    "'<f2'",
)


def faulty_npz(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one fault in a .npz."""
    members = members_of(data)
    name = dice.choice(list(members))
    kind = dice.choice(
        ("numbers",) * 4 + ("arrays",) * 4 + ("shape", "shape", "type", "member", "name", "zip", "bomb", "version")
    )
    if kind in ("numbers", "arrays"):
        change = faulty_numbers if kind == "numbers" else faulty_arrays
        fault, arrays = change(dict(sorted(np.load(io.BytesIO(data)).items())), dice)
        return f"{kind} {fault}", npz_of({key: npy_of(array) for key, array in arrays.items()})
    if kind == "shape":
        shape = dice.choice(
            (
                str((edge_integer(dice),)),
                str((edge_integer(dice), 3)),
                "()",
                "(-1,)",
                "(1.5,)",
                "'x'",
                "(10**12,)",
                str((1,) * 40),
            )
        )
        members[name] = _with_header(
            members[name], re.sub(r"'shape': \(.*?\)", f"'shape': {shape}", _header(members[name]))
        )
    elif kind == "type":
        members[name] = _with_header(
            members[name], re.sub(r"'descr': '.*?'", f"'descr': {dice.choice(_TYPES)}", _header(members[name]))
        )
    elif kind == "version":
        text = dice.choice(("", "{", "x" * 70_000, "__import__('os')", "(" * 5000, "{'descr': 1}", "{**1}", "1" * 5000))
        members[name] = (
            _with_header(members[name], text)
            if dice.random() < 0.7
            else put(members[name], dice.randrange(10), dice.randbytes(1))
        )
    elif kind == "member":
        members[name] = dice.choice(
            (b"", members[name][: dice.randrange(len(members[name]))], b"\x80\x04N.", members[name] * 3)
        )
    elif kind == "name":
        members = {
            dice.choice(("../x", "/x", f"{name}.npy.npy", "", "a\x1b[31m", "f" * 5000)) if key == name else key: value
            for key, value in members.items()
        }
    elif kind == "bomb":
        amount = dice.choice((1 << 30, 3 << 30, 6 << 30))
        head = _with_header(b"", f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({amount // 12}, 3), }}")
        files = {f"{key}.npy": content for key, content in members.items()}
        return kind, with_bomb(files, f"{name}.npy", head, amount)
    whole = npz_of(members)
    if kind == "zip":
        at = dice.choice((whole.rfind(b"PK\x01\x02"), whole.rfind(b"PK\x05\x06"), 0))
        return kind, put(whole, at + dice.randrange(4, 30), packed_integer(dice, dice.choice((1, 2, 4))))
    return kind, whole


def members_of(data: bytes) -> dict[str, bytes]:
    """Return the .npy files of a .npz by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {info.filename.removesuffix(".npy"): archive.read(info) for info in archive.infolist()}


def npz_of(members: dict[str, bytes]) -> bytes:
    """Return a .npz with these members."""
    return zip_of({f"{name}.npy": content for name, content in members.items()})


def zip_of(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return a zip archive with these members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def npy_of(array: np.ndarray) -> bytes:
    """Return a .npy file."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def with_bomb(members: dict[str, bytes], name: str, head: bytes, amount: int) -> bytes:
    """Return a zip archive with a member of zeros that is a thousand times as long unpacked."""
    packed = zlib.compressobj(1, zlib.DEFLATED, -15)
    body = packed.compress(head) + packed.flush(zlib.Z_FULL_FLUSH) + zeros(amount)[2:-4]
    whole = zip_of({key: value for key, value in members.items() if key != name} | {name: b""})
    # The empty member comes last. Its local header, its directory entry and the archive's end are rewritten.
    directory = whole.rfind(b"PK\x01\x02")
    local = whole.rfind(b"PK\x03\x04", 0, directory)
    entry_start = whole.find(b"PK\x01\x02")
    sizes = struct.pack("<HHHIII", 8, 0, 33, 0, len(body), min(amount + len(head), 2**32 - 1))
    head_of_file = put(whole[local:entry_start], 8, sizes)
    entries = put(whole[entry_start : whole.rfind(b"PK\x05\x06")], directory - entry_start + 10, sizes)
    end = put(whole[whole.rfind(b"PK\x05\x06") :], 16, struct.pack("<I", local + len(head_of_file) + len(body)))
    return whole[:local] + head_of_file + body + entries + end


def _header(member: bytes) -> str:
    size = int.from_bytes(member[8:10], "little")
    return member[10 : 10 + size].decode("latin1").strip()


def _with_header(member: bytes, text: str) -> bytes:
    body = member[10 + int.from_bytes(member[8:10], "little") :] if member else b""
    packed = text.encode("latin1", "replace")[:65_000] + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(packed)) + packed + body


def faulty_pickle(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one to three faults in the operations of a pickle, or return a small pickle that asks for much memory."""
    kind = dice.choice(("remove", "double", "swap", "argument", "argument", "global", "small", "cut", "insert"))
    if kind == "small":
        return kind, dice.choice(_SMALL)(dice)
    operations = _operations(data)
    for _ in range(dice.choice((1, 1, 3))):
        index = dice.randrange(len(operations) - 1)
        if kind == "remove":
            del operations[index]
        elif kind == "double":
            operations.insert(index, operations[index])
        elif kind == "swap":
            other = dice.randrange(len(operations) - 1)
            operations[index], operations[other] = operations[other], operations[index]
        elif kind == "insert":
            operations.insert(
                index,
                dice.choice(
                    (
                        b"(",
                        b"]",
                        b"}",
                        b"N",
                        b"t",
                        b"R",
                        b"b",
                        b".",
                        b"0",
                        b"2",
                        b"Q",
                        b"\x93",
                        b"\x81",
                        b"o",
                        b"e",
                        b"u",
                        b"a",
                    )
                ),
            )
        elif kind == "global":
            places = [at for at, operation in enumerate(operations) if operation[:1] == b"c"] or [index]
            name = dice.choice(
                (
                    b"cos\nsystem\n",
                    b"cbuiltins\neval\n",
                    b"cmien.cli\nmain\n",
                    b"c\n\n",
                    b"cnumpy\nndarray\n",
                    b"c" + b"x" * 9999 + b"\n\x1b[31m\n",
                )
            )
            operations[dice.choice(places)] = name
        elif len(operations[index]) > 1:
            size = len(operations[index]) - 1
            operations[index] = operations[index][:1] + packed_integer(dice, min(size, 8)) + operations[index][9:]
    whole = b"".join(operations)
    return kind, whole[: dice.randrange(len(whole))] if kind == "cut" else whole


def _operations(data: bytes) -> list[bytes]:
    starts = [position for _, _, position in pickletools.genops(data) if position is not None]
    return [data[start:end] for start, end in zip(starts, [*starts[1:], len(data)], strict=True)]


def _amount(dice: Random) -> int:
    return abs(dice.choice(INTEGERS[5:21]))


_SMALL: tuple[Any, ...] = (
    lambda dice: b"\x80\x02Nr" + struct.pack("<I", _amount(dice) % 2**32) + b".",
    lambda dice: b"\x80\x04\x8d" + struct.pack("<Q", _amount(dice) % 2**64) + b".",
    lambda dice: b"\x80\x04\x8e" + struct.pack("<Q", _amount(dice) % 2**64) + b".",
    lambda dice: b"\x80\x05\x96" + struct.pack("<Q", _amount(dice) % 2**64) + b".",
    lambda dice: b"\x80\x04\x95" + struct.pack("<Q", _amount(dice) % 2**64) + b"N.",
    lambda dice: b"\x80\x02\x8b" + struct.pack("<i", min(_amount(dice), 2**31 - 1)) + b".",
    lambda dice: b"I" + b"9" * dice.choice((400, 5000)) + b"\n.",
    lambda dice: b"(" * dice.choice((1000, 10**6)) + b".",
    lambda dice: b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".",
    lambda dice: b"\x80\x02}q\x00(X\x01\x00\x00\x00fh\x00u.",
    lambda dice: b"c__main__\nx\n(I1\ntRp0\n.",
    lambda dice: b"g" + str(_amount(dice)).encode() + b"\n.",
    lambda dice: b"Np" + str(_amount(dice)).encode() + b"\n.",
)
