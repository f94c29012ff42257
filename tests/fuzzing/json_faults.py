"""Make faults in json: edge values; missing, doubled, renamed or mistyped entries; and faults of its text."""

import json
import re
from collections.abc import Iterator
from random import Random
from typing import Any

from fuzzing.edges import DEEP, TEXTS, edge_number, edge_value

Place = tuple[Any, Any]
"""Container, and the key or index of one of its entries."""


def places(value: Any) -> Iterator[Place]:
    """Return all entries of all containers."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from places(value[key])


def faulty_json(value: Any, dice: Random) -> tuple[str, Any]:
    """Make one to three faults in a copy of a json value, and return it with their names."""
    changed = json.loads(json.dumps(value))
    names = []
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        found = list(places(changed))
        if not found or dice.random() < 0.02:
            return "whole", edge_value(dice)
        container, key = _picked(found, dice)
        name = dice.choice(_FAULTS)
        names.append(name)
        _apply(name, container, key, dice)
    return "+".join(names), changed


_FAULTS = (
    "edge", "edge", "edge", "edge", "edge", "number", "number", "remove", "rename", "swap", "wrap", "unwrap",
    "double", "add", "type",
)  # fmt: skip


def _picked(found: list[Place], dice: Random) -> Place:
    """Choose a place; entries near the top are as likely as the many numbers further down."""
    container, key = dice.choice(found)
    if isinstance(container, list) and len(container) > 3 and dice.random() < 0.5:
        outer = [place for place in found if isinstance(place[0], dict)]
        return dice.choice(outer) if outer else (container, key)
    return container, key


def _apply(name: str, container: Any, key: Any, dice: Random) -> None:
    old = container[key]
    if name == "edge":
        container[key] = edge_value(dice)
    elif name == "number":
        container[key] = edge_number(dice)
    elif name == "remove":
        del container[key]
    elif name == "rename" and isinstance(container, dict):
        container[dice.choice((*TEXTS, key + "s", key.upper()))] = container.pop(key)
    elif name == "swap":
        other = dice.choice(list(container) if isinstance(container, dict) else range(len(container)))
        container[key], container[other] = container[other], old
    elif name == "wrap":
        container[key] = dice.choice(([old], {"value": old}, [old, old]))
    elif name == "unwrap" and isinstance(old, (list, dict)) and old:
        container[key] = next(iter(old.values())) if isinstance(old, dict) else old[0]
    elif name == "double" and isinstance(old, (list, str)):
        container[key] = old * dice.choice((2, 3, 50))
    elif name == "add" and isinstance(container, dict):
        container[dice.choice((*TEXTS, "kind", "checksum", "future"))] = edge_value(dice)
    elif name == "type":
        container[key] = _of_another_type(old)
    else:
        container[key] = edge_value(dice)


def _of_another_type(old: Any) -> Any:
    if isinstance(old, bool) or old is None:
        return str(old)
    if isinstance(old, (int, float)):
        return str(old)
    if isinstance(old, str):
        return len(old)
    if isinstance(old, list):
        return {str(index): item for index, item in enumerate(old)}
    return list(old.items())


def written(value: Any, dice: Random) -> bytes:
    """Return a json value as bytes, including values that json cannot express."""
    text = json.dumps(value, indent=dice.choice((None, 1)), ensure_ascii=dice.random() < 0.5)
    if dice.random() < 0.7:
        text = text.replace("Infinity", "1e999")
    return re.sub(f'"{DEEP}([0-9]+)"', lambda match: nested(int(match[1])), text).encode("utf-8", "surrogatepass")


def nested(depth: int) -> str:
    """Return brackets nested in brackets."""
    return "[" * depth + "]" * depth


def faulty_text(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make a fault in the text of a json file that no value can express."""
    text = data.decode("utf-8", "replace")
    numbers = list(re.finditer(r"-?[0-9.]+(e-?[0-9]+)?", text))
    kind = dice.choice(("literal", "literal", "twice", "tail", "encoding", "deep", "quotes", "bytes", "comment"))
    if kind == "literal" and numbers:
        literals = (
            "NaN",
            "-Infinity",
            "1e999",
            "-1e999",
            "9" * 400,
            "9" * 5000,
            "0x10",
            "01",
            "1.",
            ".5",
            "1e",
            "--1",
            "1_0",
            "٣",
        )
        found = dice.choice(numbers)
        return kind, (text[: found.start()] + dice.choice(literals) + text[found.end() :]).encode()
    if kind == "twice":
        return kind, text.replace("{", '{"format": 1, "version": [], "checksum": null,', 1).encode()
    if kind == "tail":
        return kind, data + dice.choice((b"x", b"{}", b"\x00", b"]" * 1000, b" " * 100_000))
    if kind == "encoding":
        return kind, text.encode(dice.choice(("utf-16", "utf-32", "utf-8-sig", "utf-7")))
    if kind == "deep":
        return kind, nested(dice.choice((900, 1000, 100_000))).encode()
    if kind == "quotes":
        return kind, text.replace('"', "'", dice.choice((1, 2, -1))).encode()
    if kind == "comment":
        return kind, b"// json\n" + data
    at = dice.randrange(len(data) + 1)
    return "bytes", data[:at] + dice.choice(
        (b"\xff", b"\xc3", b"\x00", b"\xed\xa0\x80", b"\x1b[31m", b'\\ud800"')
    ) + data[at:]
