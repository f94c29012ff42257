"""Additions of other packages to the registries: entry points (`importlib.metadata`) of groups such as `mien.formats`.

Entry points are read at their first use, because that takes 30 ms, which most commands do not need.

A faulty addition stops only what asks for it by name. Lists leave it out, with a warning that names its package.
"""

import importlib
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from mien.errors import UserError
from mien.machine.terminal import tell

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_EXTRAS = {
    "video": "av",
    "create": "torch filelock cv2 mediapipe ai_edge_litert anny stlpips_pytorch matplotlib PIL jinja2 scipy zstandard",
    "viewer": "viser",
    "studio": "starlette uvicorn segno",
    "usd": "pxr",
    "cuda": "gsplat",
    "batch": "submitit ray fsspec s3fs",
}
EXTRA_OF = {module: extra for extra, modules in _EXTRAS.items() for module in modules.split()}
"""Name of a module -> the extra that installs it."""
PACKAGE_OF = {
    "cv2": "opencv-python-headless", "ai_edge_litert": "ai-edge-litert", "stlpips_pytorch": "stlpips-pytorch",
    "PIL": "pillow", "pxr": "usd-core",
}  # fmt: skip
"""Name of a module -> name of its package, if that is another."""
_OF_FILES = ("render", "view", "drive")
"""Sub-commands that need nothing but PyAV to write a film of a .mien file. Others need all of `create` soon after."""
_LAST_PYTHON_OF_MEDIAPIPE = (3, 12)
_LIBRARY = ": cannot open shared object file"


def missing_package(error: ImportError, command: str = "") -> str | None:
    """One line about a package that is missing, with the command that installs it. None if it is none of the extras'.

    `command` is the sub-command that runs.
    """
    module = (error.name or "").partition(".")[0]
    if _LIBRARY in str(error):
        library = str(error).partition(_LIBRARY)[0].split()[-1]
        return (
            f"a package needs the system's library {library}, which is missing; install it (Debian and Ubuntu: "
            "apt-get install libgl1 libglib2.0-0), or install opencv-python-headless in place of opencv-contrib-python"
        )
    if module not in EXTRA_OF or not isinstance(error, ModuleNotFoundError):
        return None
    package, extra = PACKAGE_OF.get(module, module), EXTRA_OF[module]
    if extra == "video" and command not in _OF_FILES:
        extra = "create"
    if module == "mediapipe" and sys.version_info[:2] > _LAST_PYTHON_OF_MEDIAPIPE:
        here = ".".join(map(str, sys.version_info[:2]))
        return (
            f"the detector mediapipe 0.10.21 has no package for Python {here}; leave out --capture.detector, so that "
            "ai-edge-litert finds the faces"
        )
    return f"this needs the package {package}, which is not installed; run `pip install 'mien[{extra}]'`"


_T = TypeVar("_T")


def plugin_names(group: str) -> list[str]:
    """Return the names of what installed packages add to a registry, sorted. Nothing of theirs is imported."""
    return list(_points(group))


def plugin(group: str, name: str, kind: type[_T]) -> _T | None:
    """Return what an installed package adds to a registry under a name; None if none does.

    The group of entry points is such as "mien.formats". The object that the entry point names is of the class `kind`.
    """
    loaded = _loaded(group, name, kind)
    if isinstance(loaded, UserError):
        raise loaded
    return loaded


def plugins(group: str, kind: type[_T]) -> dict[str, _T]:
    """Return all that installed packages add to a registry, by name and sorted by it.

    What `plugin` refuses is left out, with a warning.
    """
    found = {name: _loaded(group, name, kind) for name in plugin_names(group)}
    for loaded in found.values():
        if isinstance(loaded, UserError):
            warn(str(loaded))
    return {name: loaded for name, loaded in found.items() if isinstance(loaded, kind)}


@dataclass(frozen=True)
class Added:
    """Something that an installed package adds to a registry."""

    group: str
    name: str
    package: str
    version: str
    place: str
    """MODULE:NAME of the object."""
    fault: str | None
    """Why mien leaves it out; None if it can be used."""


def added(group: str, kind: type[_T]) -> list[Added]:
    """Return all that installed packages add to a registry, sorted by name, with what is wrong with each."""
    found = []
    for name, points in _points(group).items():
        loaded = _loaded(group, name, kind)
        fault = str(loaded) if isinstance(loaded, UserError) else None
        for point in points:
            version = point.dist.version if point.dist else "unknown"
            found.append(Added(group, name, _package(point), version, point.value, fault))
    return found


def with_plugins(group: str, kind: type[_T], own: Sequence[_T], words: Callable[[_T], Iterable[str]]) -> list[_T]:
    """Return a registry: mien's own objects, then those of other packages.

    What `plugin` refuses is left out, with a warning, and so is an object that has a word of one before it. `words`
    returns the words by which an object is found.
    """
    found = list(own)
    for name, added in plugins(group, kind).items():
        taken = {word for each in found for word in words(each)}
        if clash := taken & set(words(added)):
            one, package = kind.__name__.lower(), _package(_points(group)[name][0])
            warn(f"the {one} {name!r}: {min(clash)} is taken by another {one}; update or uninstall {package}")
        else:
            found.append(added)
    return found


@cache
def warn(fault: str) -> None:
    """Tell that something is left out of a registry, once in a process."""
    tell(f"warning: {fault}; mien goes on without it")


@cache
def _loaded(group: str, name: str, kind: type[_T]) -> _T | UserError | None:
    """Return what an entry point names, or what is wrong with it. A module that fails is imported only once."""
    points = _points(group).get(name, ())
    if len(points) > 1:
        packages = " and ".join(map(_package, points))
        return UserError(f"{packages} both add {name!r} to {group}; uninstall one of them")
    for point in points:
        package = _package(point)
        remedy = f"update or uninstall {package}"
        try:
            loaded = point.load()
        except (Exception, SystemExit) as error:  # whatever the code of another package raises
            return UserError(f"{point.value}: {package} adds it to {group}; it fails ({error!r}); {remedy}")
        if isinstance(loaded, kind):
            return loaded
        return UserError(f"{point.value}: {package} adds it to {group}, and it is no {kind.__name__}; {remedy}")
    return None


@cache
def _points(group: str) -> "dict[str, list[EntryPoint]]":
    """Return the entry points of a group by name, sorted by it. Two packages may use one name."""
    from importlib.metadata import entry_points  # takes 20 ms

    found: dict[str, list[EntryPoint]] = {}
    for point in sorted(entry_points(group=group), key=lambda each: each.name):
        found.setdefault(point.name, []).append(point)
    return found


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist else "an unknown package"


def named(place: str) -> Any:
    """The object of a module that is named as "MODULE:NAME". The module is imported now."""
    module, name = place.split(":")
    return getattr(importlib.import_module(module), name)
