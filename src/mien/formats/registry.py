"""The list of formats. A new format is one file in this folder and one line here (CONTRIBUTING.md, "Add a format").

Other packages add formats by entry points of the group `mien.formats`.
"""

from collections.abc import Callable
from pathlib import Path

from mien.formats.format import Format
from mien.formats.gaussian_avatars import GAUSSIAN_AVATARS
from mien.formats.glb import GLB
from mien.formats.mien import MIEN
from mien.formats.page import PACKED, PAGE
from mien.formats.ply import PLY
from mien.formats.sog import SOG
from mien.formats.spz import SPZ
from mien.formats.usd import USD
from mien.formats.vrm import VRM
from mien.plugins import plugin, with_plugins

_OWN = (MIEN, PAGE, PACKED, GLB, VRM, PLY, SPZ, SOG, USD, GAUSSIAN_AVATARS)

_GROUP = "mien.formats"
"""Group of entry points of other packages. They are imported only for lists, and for formats that mien lacks."""


def formats() -> list[Format]:
    """Return all formats: mien's own first, then those of other packages.

    A format is left out, with a warning, if it cannot be imported, or has the name or an ending of one before it.
    """
    return with_plugins(_GROUP, Format, _OWN, lambda each: (each.name, *each.endings))


def endings(only_from_files: bool = False) -> list[str]:
    """Return the endings of all formats, or of those that an avatar in a file can be written as."""
    return [ending for each in formats() if each.from_files or not only_from_files for ending in each.endings]


def format_of(path: Path) -> Format | None:
    """Return the format of a file by its ending, in any case; None if there is none."""
    ending = path.suffix.lower()
    return _first(lambda each: ending in each.endings) if ending else None


def find_format(name: str) -> Format | None:
    """Return a format by its name, or by an ending without its dot; None if there is none."""
    if all(each.name != name for each in _OWN):
        plugin(_GROUP, name, Format)
    return _first(lambda each: each.name == name or f".{name}" in each.endings)


def _first(fits: Callable[[Format], bool]) -> Format | None:
    """Return the first format that fits. Other packages are asked only if it is none of mien's own."""
    own = next(filter(fits, _OWN), None)
    return own or next(filter(fits, formats()), None)


def numbered(path: Path, index: int) -> Path:
    """Return the path of one frame of a motion, for formats that hold one pose: NAME_000000.ply."""
    return path.with_name(f"{path.stem}_{index:06d}{path.suffix.lower()}")
