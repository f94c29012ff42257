"""The public API, found in the code: what the doors of rooms export.

A door is a package or module directly in `mien`, or in `mien.lab`, that has an `__all__`.
"""

import ast
import importlib.util
import inspect
import pkgutil
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sphinx.pycode import ModuleAnalyzer


@dataclass(frozen=True)
class PublicName:
    """A name that a door exports."""

    door: str
    """Full name of the door."""
    name: str
    home: str
    """Full name of the module that defines it."""

    @property
    def full(self) -> str:
        """The name under which it is imported."""
        return f"{self.door}.{self.name}"

    @property
    def value(self) -> Any:
        """The object itself."""
        return getattr(importlib.import_module(self.door), self.name)

    @property
    def doc(self) -> str:
        """Its docstring. That of a constant is the string below its definition."""
        if inspect.isclass(self.value) or inspect.isroutine(self.value):
            return inspect.getdoc(self.value) or ""
        lines = ModuleAnalyzer.for_module(self.home).find_attr_docs().get(("", self.name), [])
        return "\n".join(lines).strip()


@cache
def doors() -> dict[str, list[PublicName]]:
    """The names of each door, in the order of its `__all__`."""
    found = {}
    houses = [importlib.import_module(name) for name in ("mien", "mien.lab")]
    for module in (room for house in houses for room in pkgutil.iter_modules(house.__path__, f"{house.__name__}.")):
        if _has_all(module.name):
            exported = importlib.import_module(module.name).__all__
            found[module.name] = [PublicName(module.name, name, home_of(module.name, name)) for name in exported]
    return found


def home_of(module: str, name: str) -> str:
    """The module that defines a name which `module` defines or imports."""
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ImportFrom) and node.module and any(_known_as(alias) == name for alias in node.names):
            return home_of(node.module, name) if node.module.split(".")[0] == "mien" else node.module
    return module


def exists(name: str) -> bool:
    """Whether a full name such as `mien.face.FaceParams.to` or `mien.capture` leads to something."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            value: Any = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        return _has_path(value, parts[end:])
    return False


def _has_path(value: Any, path: list[str]) -> bool:
    for part in path:
        annotated = part in getattr(value, "__annotations__", {})  # a field of a dataclass has no value
        if not annotated and not hasattr(value, part):
            return False
        value = getattr(value, part, None)
    return True


def _known_as(alias: ast.alias) -> str:
    return alias.asname or alias.name


def _has_all(module: str) -> bool:
    return any(
        isinstance(node, ast.Assign) and any(isinstance(to, ast.Name) and to.id == "__all__" for to in node.targets)
        for node in _tree(module).body
    )


@cache
def _tree(module: str) -> ast.Module:
    spec = importlib.util.find_spec(module)
    assert spec is not None, module
    if spec.origin is None or not spec.origin.endswith(".py"):  # the native core
        return ast.Module(body=[], type_ignores=[])
    return ast.parse(Path(spec.origin).read_text("utf-8"))


def first_line(module: ModuleType) -> str:
    """The first sentence of a module's docstring."""
    return (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")
