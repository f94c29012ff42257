"""The list of formats. A new format is one file in this folder and one row here (CONTRIBUTING.md, "Add a format").

The files of the formats are imported at their first use, since most need torch and the command line only lists them.
Other packages add formats by entry points of the group `mien.formats`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mien.formats.format import Format, NoOptions, SplatOptions
from mien.plugins import named, plugin, with_plugins


def _of(place: str) -> Callable[..., Any]:
    """A function or a class of a file of this folder, "FILE:NAME"."""
    return lambda *arguments: named(f"mien.formats.{place}")(*arguments)


_USD = (".usd", ".usda", ".usdc", ".usdz")
_OWN = (
    Format("mien", "avatar", _of("mien:write"), (".mien",), _of("mien:read_portable"), _of("mien:MienOptions")),
    Format(
        "html", "avatar", _of("page:write"), (".html",), options=_of("page:PageOptions"), check=_of("page:check_page")
    ),
    Format(
        "packed",
        "avatar",
        _of("page:write_packed_file"),
        (".packed",),
        options=_of("page:PackedOptions"),
        check=_of("page:check_packed"),
    ),
    Format("glb", "avatar", _of("glb:write"), (".glb",), _of("glb:read_glb_avatar"), _of("glb:GlbOptions")),
    Format("vrm", "avatar", _of("vrm:write"), (".vrm",), options=NoOptions),
    Format("ply", "pose", _of("ply:write"), (".ply",), options=_of("ply:PlyOptions")),
    Format("spz", "pose", _of("spz:write"), (".spz",), options=_of("spz:SpzOptions")),
    Format("sog", "pose", _of("sog:write"), (".sog",), options=SplatOptions),
    Format("usd", "sequence", _of("usd:write"), _USD, check=_of("usd:check_usd")),
    Format("gaussian-avatars", "folder", _of("gaussian_avatars:write"), options=NoOptions),
)

_GROUP = "mien.formats"
"""Group of entry points of other packages. They are imported only for lists, and for formats that mien lacks."""


def formats() -> list[Format]:
    """Return all formats: mien's own first, then those of other packages.

    A format is left out, with a warning, if it cannot be imported, or has the name or an ending of one before it.
    """
    return with_plugins(_GROUP, Format, _OWN, lambda each: (each.name, *each.endings))


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
    return next(filter(fits, _OWN), None) or next(filter(fits, formats()), None)


def numbered(path: Path, index: int) -> Path:
    """Return the path of one frame of a motion, for formats that hold one pose: NAME_000000.ply."""
    return path.with_name(f"{path.stem}_{index:06d}{path.suffix.lower()}")
