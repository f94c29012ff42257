"""Constants of tracking, capture, face models and driving: each says what it is, and some function reads it."""

import ast
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

import mien
from mien.capture.constants import CAPTURE
from mien.commands.help_text import field_docs
from mien.driving.constants import DRIVING
from mien.face.constants import FACE
from mien.tracking.constants import TRACKING

ROOMS = {"CAPTURE": CAPTURE, "DRIVING": DRIVING, "FACE": FACE, "TRACKING": TRACKING}
USED = {
    ast.unparse(node)
    for path in Path(mien.__file__).parent.rglob("*.py")
    for node in ast.walk(ast.parse(path.read_text()))
    if isinstance(node, ast.Attribute)
}


def _constants(name: str, room: Any) -> Iterator[tuple[str, str, bool]]:
    """Each constant's name, its name behind the local name `known`, and whether its class documents it."""
    docs = field_docs(type(room))
    for field in fields(room):
        value = getattr(room, field.name)
        if is_dataclass(value):
            yield from _constants(f"{name}.{field.name}", value)
        else:
            yield f"{name}.{field.name}", f"known.{field.name}", bool(docs.get(field.name))


@pytest.mark.parametrize("room", ROOMS)
def test_every_constant_says_what_it_is_and_is_used(room: str) -> None:
    for name, local, documented in _constants(room, ROOMS[room]):
        assert documented, name
        assert {name, local} & USED, f"nothing uses {name}"
