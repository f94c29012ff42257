"""What other packages add to the registries: entry points (`importlib.metadata`) of groups such as `mien.formats`."""

from functools import cache
from importlib.metadata import entry_points
from typing import TypeVar

from mien.errors import UserError

_T = TypeVar("_T")


@cache
def plugins(group: str, kind: type[_T]) -> dict[str, _T]:
    """Return what installed packages add to a registry, by the names of the entry points, sorted by name.

    Args:
        group: Group of entry points, such as "mien.formats".
        kind: Class of the objects that the entry points name.

    Raises:
        UserError: an entry point cannot be imported, or is something else. It names the package.
    """
    found = {}
    for point in sorted(entry_points(group=group), key=lambda each: each.name):
        package = point.dist.name if point.dist else "an unknown package"
        remedy = f"update or uninstall {package}"
        try:
            loaded = point.load()
        except Exception as error:  # whatever the code of another package raises
            raise UserError(f"{point.value}: {package} adds it to {group}; it fails ({error!r}); {remedy}") from error
        if not isinstance(loaded, kind):
            raise UserError(f"{point.value}: {package} adds it to {group}, and it is no {kind.__name__}; {remedy}")
        found[point.name] = loaded
    return found
