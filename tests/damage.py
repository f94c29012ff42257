"""Damage to files: flipped bits, cut ends, and edits of json behind the back of its checksum."""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a json file as an old or foreign version of mien might have written it: without a checksum."""
    content = json.loads(path.read_text())
    content.pop("checksum", None)
    change(content)
    path.write_text(json.dumps(content))


def flip_or_cut(data: bytes, dice: random.Random) -> bytes:
    """One random damage: an end cut off, a bit flipped, or some neighbouring bytes replaced."""
    kind = dice.choice(("cut", "bit", "bit", "bytes")) if data else "bytes"
    if kind == "cut":
        return data[: dice.randrange(len(data))]
    changed = bytearray(data)
    # Headers are where a reader can go astray, so half of the damage goes there.
    start = dice.randrange(min(len(data), 256) if dice.random() < 0.5 else len(data)) if data else 0
    if kind == "bit":
        changed[start] ^= 1 << dice.randrange(8)
    else:
        changed[start : start + 8] = dice.randbytes(len(changed[start : start + 8]) or 1)
    return bytes(changed)


def nested(depth: int) -> list[Any]:
    """Return empty lists inside each other, this deep."""
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner]
    return inner
