"""Damage files: flip bits, cut ends, and edit json without correcting its checksum."""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a json file and drop its checksum, as in a file of a foreign program."""
    content = json.loads(path.read_text())
    content.pop("checksum", None)
    change(content)
    path.write_text(json.dumps(content))


def flip_or_cut(data: bytes, dice: random.Random) -> bytes:
    """Damage data once at random: cut off an end, flip a bit, or replace some neighbouring bytes."""
    kind = dice.choice(("cut", "bit", "bit", "bytes")) if data else "bytes"
    if kind == "cut":
        return data[: dice.randrange(len(data))]
    changed = bytearray(data)
    # Readers fail most easily on headers, so half of the damage is there.
    start = dice.randrange(min(len(data), 256) if dice.random() < 0.5 else len(data)) if data else 0
    if kind == "bit":
        changed[start] ^= 1 << dice.randrange(8)
    else:
        changed[start : start + 8] = dice.randbytes(len(changed[start : start + 8]) or 1)
    return bytes(changed)


def nested(depth: int) -> list[Any]:
    """Return a list within a list and so on, `depth` levels deep."""
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner]
    return inner
