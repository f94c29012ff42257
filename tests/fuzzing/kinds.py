"""Values at edges that break readers, and faults of every kind of content: bytes, lists, texts, json and arrays."""

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

import numpy as np

INTEGERS = (
    0, 1, -1, 2, 7, 255, 256, 65535, 65536, 2**24 + 1, 4 * 10**8, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**32,
    2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64 - 1, 2**64, 10**400, -(10**400),
)  # fmt: skip
FLOATS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 3.5e38, 1e308, 1e-320, -0.0, 0.5, 1e16, 1e-9, 1e30, -1e30)
CANARY, PORT = "@CANARY@", "@PORT@"
"""Placeholders for the folder that nothing may be written into, and for the port that nothing may connect to."""
DEEP = "@DEEP"
"""Placeholder for nested brackets; the digits after it give the depth."""
SCRIPT = "<script>mien_fuzz(1)</script>"
"""Text that must be escaped in every report."""
TEXTS = (
    "", " ", "text", "0", "nan", "null", "x" * 300, "x" * 100_000, "a\nb", "\x1b]0;own\x07\x1b[31mred", "a\x00b",
    "\u202eabc", "\ud800", "\x9b31m", "..", ".", "/", "../../x", "../" * 12 + "etc/passwd", f"{CANARY}/victim.json",
    f"../../../..{CANARY}/victim", "C:\\x", "con", "-", "--help", "a:b", f"http://127.0.0.1:{PORT}/x", "%s%n", "{0}",
    SCRIPT, "größer", "\U0001f600", "é" * 200,
)  # fmt: skip
LITERALS = (
    "NaN", "inf", "-inf", "1e400", "-1e999", "3e38", "9" * 400, "9" * 5000, "0x10", "01", "1.", ".5", "1e", "--1",
    "1_0", "\u0663", "1,5", "1.2.3", "=1+1", "x" * 200_000, "99:59:59:59", "-1:0:0:0", "0:0:0:1e9",
    "9" * 400 + ":0:0:0", "0:0:0:0." + "9" * 400, "24:00:00:00", "0:00:00;29", "\u0663:00:00:00", "5000:0:0:0",
    ":::", "double", "uchar", "int",
)  # fmt: skip
"""Words of a text that is no json."""
_TEBIBYTE = (1 << 40).to_bytes(8, "little")
SMALL_PICKLES = {
    "bytes of a tebibyte": b"\x80\x04\x8e" + _TEBIBYTE + b".",
    "a bytearray of a tebibyte": b"\x80\x05\x96" + _TEBIBYTE + b".",
    "a text of a tebibyte": b"\x80\x04\x8d" + _TEBIBYTE + b".",
    "a frame of a tebibyte": b"\x80\x04\x95" + _TEBIBYTE + b"N.",
    "a memo of two billion": b"]r\xff\xff\xff\x7f.",
    "a memo of digits": b"]p" + b"9" * 4000 + b"\n.",
    "a number of two gigabytes": b"\x8b\xff\xff\xff\x7f.",
    "digits": b"I" + b"9" * 10_000 + b"\n.",
    "a doubled tuple": b"}(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"u.",
    "a doubled tuple for a key": b"}(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"N" + b"u.",
    "a doubled set": b"\x8f(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"\x90.",
    "thousands of dictionaries": b"}" * 20_000 + b".",
    "names without end": b"ca\nb\n" * 20_000 + b".",
    "nested lists": b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".",
    "a stack that is empty": b"0.",
    "a mark that is missing": b"t.",
    "marks": b"(" * 10**5 + b".",
    "a persistent name": b"Pname\n.",
    "an extension": b"\x82\x01.",
    "a cycle": b"}(X\x01\x00\x00\x00fca\nb\n)\x81q\x01}X\x01\x00\x00\x00xh\x01sbu.",
}
"""Pickles that ask for much memory or time."""
_DEPTHS = (2, 100, 500, 990, 1000, 5000, 100_000)


def edge_integer(dice: Random) -> int:
    return dice.choice(INTEGERS) + dice.choice((0, 0, 0, 1, -1))


def edge_number(dice: Random) -> int | float:
    return edge_integer(dice) if dice.random() < 0.5 else dice.choice(FLOATS)


def edge_value(dice: Random) -> Any:
    kind = dice.randrange(8)
    if kind < 3:
        return edge_number(dice)
    if kind < 5:
        return dice.choice(TEXTS)
    if kind == 5:
        return f"{DEEP}{dice.choice(_DEPTHS)}"
    return dice.choice(
        (None, True, False, [], {}, [[]], [None], {"": 0}, [0] * 1000, [[0, 0], [0]], {"tensor": "x"}, {"kind": "x"})
    )


def packed_integer(dice: Random, size: int, order: str = "little") -> bytes:
    """Return an edge as an unsigned field of this many bytes."""
    value = edge_integer(dice) if dice.random() < 0.8 else dice.getrandbits(8 * size)
    return (value % (1 << 8 * size)).to_bytes(size, "little" if order == "little" else "big")


def put(data: bytes, at: int, field: bytes) -> bytes:
    return data[:at] + field + data[at + len(field) :]


# Bytes, lists and texts -----------------------------------------------------------------------------------------------


def faulty_bytes(data: bytes, dice: Random, head: int = 512) -> tuple[str, bytes]:
    """Make one to three faults: in the first or last bytes, where a file says what it holds, or anywhere."""
    kind = dice.choice(("byte", "byte", "field", "field", "field", "noise", "cut", "double", "remove"))
    for _ in range(dice.choice((1, 1, 3))):
        size, order = max(len(data), 1), dice.choice(("little", "big"))
        near = dice.randrange(min(size, head))
        at = dice.choice((near, near, size - 1 - near, dice.randrange(size)))
        if kind == "byte":
            data = put(data, at, bytes([edge_integer(dice) % 256]))[:size]
        elif kind == "field":
            data = put(data, at, packed_integer(dice, dice.choice((1, 2, 4, 8)), order))[:size]
        elif kind == "noise":
            data = put(data, at, dice.randbytes(dice.choice((1, 8, 200))))[:size]
        elif kind == "double":
            data = data[:at] + data[max(0, at - 2000) : at] * 2 + data[at:]
        elif kind == "remove":
            data = data[:at] + data[at + dice.choice((1, 100, 5000)) :]
    return kind, data[: dice.randrange(len(data) + 1)] if kind == "cut" else data


def faulty_list(items: Sequence[Any], dice: Random) -> list[Any]:
    items, kind = list(items), dice.choice(("remove", "double", "swap", "shuffle", "cut"))
    one, other = dice.randrange(len(items)), dice.randrange(len(items))
    if kind == "remove":
        del items[one]
    elif kind == "double":
        items[one:one] = [items[other]] * dice.choice((1, 1, 300))
    elif kind == "swap":
        items[one], items[other] = items[other], items[one]
    elif kind == "shuffle":
        dice.shuffle(items)
    return items[:other] if kind == "cut" else items


_TOKEN = re.compile(r"[^\s,\[\]{}()\"=]+")


def faulty_text(data: bytes, dice: Random, lines: tuple[str, ...] = ()) -> tuple[str, bytes]:
    """Make a fault in a text: in its words and numbers, its lines (some may be inserted), columns or encoding."""
    encoding = json.detect_encoding(data)
    text = data.decode(encoding, "replace")
    comma = max(",;\t", key=text.partition("\n")[0].count)
    kind = dice.choice(("token",) * 6 + ("lines", "lines", "columns", "encoding", "encoding", "deep") + ("insert",) * 3)
    if kind == "token":
        found = list(_TOKEN.finditer(text))
        for one in reversed(
            sorted(dice.sample(found, min(len(found), dice.choice((1, 1, 3, 20)))), key=re.Match.start)
        ):
            other = dice.choice((*LITERALS, *TEXTS, repr(edge_number(dice)), *(dice.choice(found)[0],) * 20))
            text = text[: one.start()] + other + text[one.end() :]
    elif kind == "lines" and text:
        text = "\n".join(faulty_list(text.splitlines(), dice)) + dice.choice(("\n", ""))
    elif kind == "columns" and comma in text:
        rows = [line.split(comma) for line in text.splitlines()]
        order = faulty_list(range(len(rows[0])), dice)
        text = "\n".join(comma.join(row[index] for index in order if index < len(row)) for row in rows)
    elif kind == "insert":
        rows = text.splitlines()
        rows.insert(dice.randrange(len(rows) + 1), dice.choice((*lines, "", "x" * 200_000, '"', '"' * 1001, *TEXTS)))
        text = dice.choice(("\n", "\n", "\r\n", "\r")).join([*rows, ""])
    elif kind == "deep":
        text = dice.choice((nested(dice.choice((900, 1000, 100_000))), "\n" * 100_000, "," * 100_000, ""))
    whole = text.encode(encoding, "surrogatepass")
    return kind, _faulty_encoding(whole, dice) if kind == "encoding" else whole


def _faulty_encoding(data: bytes, dice: Random) -> bytes:
    if dice.random() < 0.3:
        return data.decode("utf-8", "replace").encode(dice.choice(("utf-16", "utf-32", "utf-8-sig", "utf-7")))
    odd = (b"\xff", b"\xc3", b"\x00", b"\xed\xa0\x80", b"\x1b[2J", b'\\ud800"', b'"', b"'", b"// x\n", b"]" * 1000)
    at = dice.choice((0, len(data), dice.randrange(len(data) + 1)))
    return data[:at] + dice.choice(odd) + data[at:]


# Values of json -------------------------------------------------------------------------------------------------------


def entries(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container of a value, with each of its keys or indices."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from entries(value[key])


def faulty_value(value: Any, dice: Random) -> tuple[str, Any]:
    """Make one to three faults in a copy of a json value, and return it with their names."""
    changed, names = json.loads(json.dumps(value)), []
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        found = list(entries(changed))
        if not found or dice.random() < 0.02:
            return "whole", edge_value(dice)
        container, key = dice.choice(found)
        if isinstance(container, list) and len(container) > 3 and dice.random() < 0.5:  # less of long lists
            container, key = dice.choice([place for place in found if isinstance(place[0], dict)] or [(container, key)])
        names.append(dice.choice(_VALUE_FAULTS))
        _apply(names[-1], container, key, dice)
    return "+".join(names), changed


_VALUE_FAULTS = (*("edge",) * 5, "number", "number", "remove", "rename", "swap", "wrap", "unwrap", "double", "add",
                 "type", "share")  # fmt: skip


def _apply(name: str, container: Any, key: Any, dice: Random) -> None:
    old, mapping = container[key], isinstance(container, dict)
    if name == "number":
        container[key] = edge_number(dice)
    elif name == "remove":
        del container[key]
    elif name == "rename" and mapping:
        container[dice.choice((*TEXTS, key + "s", key.upper()))] = container.pop(key)
    elif name == "swap":
        other = dice.choice(list(container) if mapping else range(len(container)))
        container[key], container[other] = container[other], old
    elif name == "wrap":
        container[key] = dice.choice(([old], {"value": old}, [old, old]))
    elif name == "unwrap" and isinstance(old, (list, dict)) and old:
        container[key] = next(iter(old.values())) if isinstance(old, dict) else old[0]
    elif name == "double" and isinstance(old, (list, str)):
        container[key] = old * dice.choice((2, 3, 50))
    elif name == "add" and mapping:
        container[dice.choice((*TEXTS, "kind", "checksum", "future"))] = edge_value(dice)
    elif name == "share" and mapping and isinstance(old, dict):
        container |= {f"x{index}": old for index in range(dice.choice((1, 3000)))}
    elif name == "type":
        names = {str(index): one for index, one in enumerate(old)} if isinstance(old, list) else str(old)
        container[key] = len(old) if isinstance(old, str) else list(old.items()) if isinstance(old, dict) else names
    else:
        container[key] = edge_value(dice)


def written(value: Any, dice: Random) -> bytes:
    """Return a json value as bytes, including values that json cannot express."""
    text = json.dumps(value, indent=dice.choice((None, 1)), ensure_ascii=dice.random() < 0.5)
    text = text.replace("Infinity", "1e999") if dice.random() < 0.7 else text
    return re.sub(f'"{DEEP}([0-9]+)"', lambda match: nested(int(match[1])), text).encode("utf-8", "surrogatepass")


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


# Arrays ---------------------------------------------------------------------------------------------------------------

_KINDS = (np.float64, np.float32, np.float16, np.int64, np.int32, np.int8, np.uint8, np.uint64, np.bool_)


_SIDES = (0, 2**20, 2**31, 2**32 + 4, 2**40, 2**57)
"""Sides of arrays without numbers."""


def faulty_array(array: np.ndarray, dice: Random) -> tuple[str, np.ndarray]:
    """Change the size, the axes, the type or some numbers of an array."""
    kind = dice.choice(
        ("numbers",) * 6 + ("scaled", "longer", "shorter", "none", "type", "type", "axis", "flat", "turn")
    )
    axis = dice.randrange(max(1, array.ndim))
    with np.errstate(all="ignore"):
        if kind in ("numbers", "scaled") and array.size:
            flat = array.reshape(-1).copy()
            some = [dice.randrange(flat.size) for _ in range(dice.choice((1, 1, 3, 30)))]
            places: Any = slice(None) if dice.random() < 0.2 else some
            factor = np.array(dice.choice((-1, 2, 100))).astype(flat.dtype) if flat.dtype.kind in "fiu" else 1
            flat[places] = flat[places] * factor if kind == "scaled" else edge_for(flat.dtype, dice)
            return kind, flat.reshape(array.shape)
        changes: dict[str, Callable[[], np.ndarray]] = {
            "longer": lambda: np.repeat(array, dice.choice((2, 3)), axis=axis if array.ndim else None),
            "shorter": lambda: array[: dice.choice((len(array) // 2, -1))] if array.ndim else array[None],
            "huge": lambda: np.empty((0, dice.choice(_SIDES), *array.shape[2:]), array.dtype),
            "none": lambda: np.take(array, [], axis=axis if array.ndim else None),
            "type": lambda: array.astype(dice.choice(_KINDS)),
            "axis": lambda: array[None] if dice.random() < 0.5 else array[..., None],
            "turn": lambda: array.T,
        }
        return kind, np.ascontiguousarray(changes.get(kind, lambda: array.reshape(-1))())


def edge_for(dtype: np.dtype, dice: Random) -> Any:
    if dtype.kind == "f":
        with np.errstate(all="ignore"):
            return np.array(dice.choice(FLOATS)).astype(dtype)
    if dtype.kind not in "iu":
        return dice.random() < 0.5
    limits = np.iinfo(dtype)
    return dice.choice((limits.min, limits.max, *(one for one in INTEGERS if limits.min <= one <= limits.max)))
