"""Sphinx extension: a setting's type is shown without its marks, and its range is a sentence of its description.

Settings are written as `rounds: Annotated[int, Range(0, 100_000)] = 16`. Sphinx prints such a mark as the source of a
dataclass, which nobody reads happily.
"""

import importlib
import pkgutil
from dataclasses import is_dataclass
from typing import Annotated, Any, get_args, get_origin

from sphinx.application import Sphinx

import mien
from mien.disk.config import Range

_ranges: dict[str, str] = {}
"""Texts of ranges by class and field. A class is documented at the door of its room, not in its own module."""


def strip_marks(app: Sphinx) -> None:
    """Take the marks off the annotations of all dataclasses in mien, and note the ranges."""
    for module in pkgutil.walk_packages(mien.__path__, "mien."):
        if not module.name.endswith("__main__"):
            for thing in vars(importlib.import_module(module.name)).values():
                if isinstance(thing, type) and is_dataclass(thing) and thing.__module__ == module.name:
                    _strip(thing)


def _strip(thing: type) -> None:
    own = thing.__dict__.get("__annotations__", {})
    for name, annotation in own.items():
        for mark in get_args(annotation)[1:] if get_origin(annotation) is Annotated else ():
            if isinstance(mark, Range):
                _ranges[f"{thing.__qualname__}.{name}"] = str(mark)
    for annotations in (own, getattr(thing.__init__, "__annotations__", {})):
        for name, annotation in annotations.items():
            if get_origin(annotation) is Annotated:
                annotations[name] = get_args(annotation)[0]


def add_range(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Add a field's range to its description, in place."""
    field = ".".join(name.split(".")[-2:])
    if what == "attribute" and field in _ranges:
        while lines and not lines[-1]:
            lines.pop()
        lines += ["", f"Range: {_ranges[field]}.", ""]


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the extension."""
    app.connect("builder-inited", strip_marks)
    app.connect("autodoc-process-docstring", add_range)
    return {"parallel_read_safe": True}
