"""Additions of other packages to the registries: entry points (`importlib.metadata`) of groups such as `mien.formats`.

Entry points are read at their first use, because that takes 30 ms, which most commands do not need.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, TypeVar

from mien.errors import UserError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_T = TypeVar("_T")


def plugin_names(group: str) -> list[str]:
    """Return the names of what installed packages add to a registry, sorted. Nothing of theirs is imported.

    Raises:
        UserError: two packages use the same name.
    """
    return list(_points(group))


@cache
def plugin(group: str, name: str, kind: type[_T]) -> _T | None:
    """Return what an installed package adds to a registry under a name; None if none does.

    Args:
        group: Group of entry points, such as "mien.formats".
        name: Name of the entry point.
        kind: Class of the object that the entry point names.

    Raises:
        UserError: the entry point cannot be imported, or is something else. It names the package.
    """
    point = _points(group).get(name)
    if point is None:
        return None
    package = _package(point)
    remedy = f"update or uninstall {package}"
    try:
        loaded = point.load()
    except Exception as error:  # whatever the code of another package raises
        raise UserError(f"{point.value}: {package} adds it to {group}; it fails ({error!r}); {remedy}") from error
    if not isinstance(loaded, kind):
        raise UserError(f"{point.value}: {package} adds it to {group}, and it is no {kind.__name__}; {remedy}")
    return loaded


def plugins(group: str, kind: type[_T]) -> dict[str, _T]:
    """Return all that installed packages add to a registry, by name and sorted by it.

    Raises:
        UserError: as for `plugin` and `plugin_names`.
    """
    found = ((name, plugin(group, name, kind)) for name in plugin_names(group))
    return {name: loaded for name, loaded in found if loaded is not None}


def with_plugins(group: str, kind: type[_T], own: Sequence[_T], words: Callable[[_T], Iterable[str]]) -> list[_T]:
    """Return a registry: mien's own objects, then those of other packages.

    Args:
        group: Group of entry points, such as "mien.formats".
        kind: Class of the objects.
        own: Mien's own objects.
        words: Function that returns the words by which an object is found. No two objects may share one.

    Raises:
        UserError: as for `plugin`, or an object of another package has a word of one before it.
    """
    found = list(own)
    for name, added in plugins(group, kind).items():
        taken = {word for each in found for word in words(each)}
        if clash := taken & set(words(added)):
            one = kind.__name__.lower()
            raise UserError(f"the {one} {name!r}: {min(clash)} is taken by another {one}; uninstall its package")
        found.append(added)
    return found


@cache
def _points(group: str) -> "dict[str, EntryPoint]":
    from importlib.metadata import entry_points  # takes 20 ms

    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=group), key=lambda each: each.name):
        if point.name in found:
            packages = f"{_package(found[point.name])} and {_package(point)}"
            raise UserError(f"{packages} both add {point.name!r} to {group}; uninstall one of them")
        found[point.name] = point
    return found


def _package(point: "EntryPoint") -> str:
    return point.dist.name if point.dist else "an unknown package"
