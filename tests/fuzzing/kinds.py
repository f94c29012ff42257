"""Make faults of every kind of content: bytes, lists, texts, values of json and arrays."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

import numpy as np

from fuzzing.edges import (
    DEEP,
    FLOATS,
    INTEGERS,
    LITERALS,
    TEXTS,
    edge_integer,
    edge_number,
    edge_value,
    packed_integer,
    put,
)
from fuzzing.repairs import with_checksum

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
    """Remove, repeat, swap or shuffle items."""
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
    """Make a fault in a text: in its words and numbers, its lines, its columns or its encoding.

    Args:
        data: The text.
        dice: Random numbers.
        lines: Lines that may be inserted.
    """
    text = data.decode("utf-8", "replace")
    kind = dice.choice(("token",) * 6 + ("lines", "lines", "columns", "encoding", "encoding", "deep") + ("insert",) * 3)
    if kind == "token":
        found = list(_TOKEN.finditer(text))
        for one in reversed(sorted(dice.sample(found, min(len(found), dice.choice((1, 1, 3, 20)))), key=_start)):
            other = dice.choice((*LITERALS, *TEXTS, repr(edge_number(dice)), *(dice.choice(found)[0],) * 20))
            text = text[: one.start()] + other + text[one.end() :]
    elif kind == "lines" and text:
        text = "\n".join(faulty_list(text.splitlines(), dice)) + dice.choice(("\n", ""))
    elif kind == "columns" and "," in text:
        rows = [line.split(",") for line in text.splitlines()]
        order = faulty_list(range(len(rows[0])), dice)
        text = "\n".join(",".join(row[index] for index in order if index < len(row)) for row in rows)
    elif kind == "insert":
        rows = text.splitlines()
        rows.insert(dice.randrange(len(rows) + 1), dice.choice((*lines, "", "x" * 200_000, '"', '"' * 1001, *TEXTS)))
        text = dice.choice(("\n", "\n", "\r\n", "\r")).join([*rows, ""])
    elif kind == "deep":
        text = dice.choice((nested(dice.choice((900, 1000, 100_000))), "\n" * 100_000, "," * 100_000, ""))
    whole = text.encode("utf-8", "surrogatepass")
    return kind, _faulty_encoding(whole, dice) if kind == "encoding" else whole


def _start(found: "re.Match[str]") -> int:
    return found.start()


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
    """Return brackets nested in brackets."""
    return "[" * depth + "]" * depth


def faulty_json(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in a json file: in its text, or in its values with a checksum that is mostly correct."""
    if dice.random() < 0.15:
        return faulty_text(data, dice)
    content = json.loads(data)
    checksum = content.pop("checksum", None) if isinstance(content, dict) else None
    frame = {}
    if isinstance(content, dict) and dice.random() < 0.8:
        frame = {name: content.pop(name) for name in ("format", "version") if name in content}
    kind, content = faulty_value(content, dice)
    if isinstance(content, dict):
        content = {**frame, **content}
        chance = dice.random()
        if checksum is not None and chance < 0.75:
            content = with_checksum(content)
        elif checksum is not None and chance > 0.9:
            content["checksum"] = checksum
    return kind, written(content, dice)


def faulty_lines(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in one of the json lines of a file."""
    lines = data.splitlines()
    index = dice.choice((dice.randrange(len(lines)), len(lines) - 1, len(lines) - 1))
    kind, lines[index] = faulty_json(lines[index], dice)
    lines[index] = lines[index].replace(b"\n", b" ")
    lines += [lines[index]] * dice.choice((0, 0, 0, 1, 1000))
    return kind, b"\n".join(lines) + dice.choice((b"\n", b"\n", b""))


# Arrays ---------------------------------------------------------------------------------------------------------------

_KINDS = (np.float64, np.float32, np.float16, np.int64, np.int32, np.int8, np.uint8, np.uint64, np.bool_)


def faulty_array(array: np.ndarray, dice: Random) -> tuple[str, np.ndarray]:
    """Change the size, the axes, the type or some numbers of an array."""
    kind = dice.choice(
        (*("numbers",) * 6, "scaled", "longer", "shorter", "none", "type", "type", "axis", "flat", "turn")
    )
    axis = dice.randrange(max(1, array.ndim))
    if kind in ("numbers", "scaled") and array.size:
        flat = array.reshape(-1).copy()
        some = [dice.randrange(flat.size) for _ in range(dice.choice((1, 1, 3, 30)))]
        places: Any = slice(None) if dice.random() < 0.2 else some
        with np.errstate(all="ignore"):
            factor = np.array(dice.choice((-1, 2, 100))).astype(flat.dtype) if flat.dtype.kind in "fiu" else 1
            flat[places] = flat[places] * factor if kind == "scaled" else edge_for(flat.dtype, dice)
        return kind, flat.reshape(array.shape)
    with np.errstate(all="ignore"):
        changes: dict[str, Callable[[], np.ndarray]] = {
            "longer": lambda: np.repeat(array, dice.choice((2, 3)), axis=axis if array.ndim else None),
            "shorter": lambda: array[: len(array) // 2] if array.ndim else array[None],
            "none": lambda: np.take(array, [], axis=axis if array.ndim else None),
            "type": lambda: array.astype(dice.choice(_KINDS)),
            "axis": lambda: array[None] if dice.random() < 0.5 else array[..., None],
            "turn": lambda: array.T,
        }
        return kind, np.ascontiguousarray(changes.get(kind, lambda: array.reshape(-1))())


def edge_for(dtype: np.dtype, dice: Random) -> Any:
    """Return a number at an edge of a type."""
    if dtype.kind == "f":
        with np.errstate(all="ignore"):
            return np.array(dice.choice(FLOATS)).astype(dtype)
    if dtype.kind not in "iu":
        return dice.random() < 0.5
    limits = np.iinfo(dtype)
    return dice.choice((limits.min, limits.max, *(one for one in INTEGERS if limits.min <= one <= limits.max)))
