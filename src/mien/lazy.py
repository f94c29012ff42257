"""Imports names of a package at their first use (PEP 562), so that its settings load without its libraries."""

import ast
import importlib
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any


def lazy_names(room: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` for the `__init__` of a package.

    The names are those that the file imports under `TYPE_CHECKING`, from modules of the package. They are read from its
    source, so that they need not be listed a second time. None of them may be the name of a module of the package.

    Args:
        room: The package's `__name__`.
        file: The package's `__file__`.
    """

    @cache
    def homes() -> dict[str, str]:
        """Name -> full name of the module that defines it."""
        imports = (node for node in ast.walk(ast.parse(Path(file).read_bytes())) if isinstance(node, ast.ImportFrom))
        return {
            name.name: node.module
            for node in imports
            if node.module and node.module.startswith(f"{room}.")
            for name in node.names
        }

    def get(name: str) -> Any:
        if name not in homes():
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes()[name]), name)
        setattr(sys.modules[room], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[room]), *homes()})

    return get, names


def named(place: str) -> Any:
    """The object of a module that is named as "MODULE:NAME". The module is imported now."""
    module, name = place.split(":")
    return getattr(importlib.import_module(module), name)
