"""The list of formats. A new format is one file in this folder and one row here (CONTRIBUTING.md, "Add a format").

The files of the formats are imported at their first use, since most need torch and the command line only lists them.
Other packages add formats by entry points of the group `mien.formats`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mien.formats.format import Format
from mien.plugins import named, plugin, with_plugins


def _of(place: str) -> Callable[..., Any]:
    """A function of a file of this folder, "FILE:NAME"."""
    return lambda *arguments: named(f"mien.formats.{place}")(*arguments)


def _whole(why: str) -> dict[str, str]:
    """Why a format with all expressions does not take one of them, or a motion."""
    return dict.fromkeys(("set", "series"), f"{why}; leave --set and --series out")


_PAGE_REFUSES = {"set": "a page sets every expression itself; leave --set out"}
_OWN = (
    Format(
        "mien",
        "avatar",
        _of("mien:write"),
        (".mien",),
        _of("mien:read_portable"),
        options=frozenset({"soft_cut"}),
        refusals=_whole("a .mien file holds every expression"),
    ),
    Format(
        "html",
        "avatar",
        _of("page:write"),
        (".html",),
        options=frozenset({"webgpu", "webcam", "microphone", "title", "address", "soft_cut", "largest"}),
        refusals=_PAGE_REFUSES,
    ),
    Format(
        "packed",
        "avatar",
        _of("page:write_packed_file"),
        (".packed",),
        options=frozenset({"soft_cut", "largest"}),
        refusals=_PAGE_REFUSES,
    ),
    Format(
        "glb",
        "avatar",
        _of("glb:write"),
        (".glb",),
        _of("glb:read_glb_avatar"),
        from_files=False,
        refusals=_whole("a .glb file has a morph target for every expression"),
    ),
    Format(
        "vrm",
        "avatar",
        _of("vrm:write"),
        (".vrm",),
        from_files=False,
        refusals=_whole("a .vrm file has an expression for every name"),
    ),
    Format("ply", "pose", _of("ply:write"), (".ply",), _of("ply:read_ply"), options=frozenset({"sh"})),
    Format(
        "spz",
        "pose",
        _of("spz:write"),
        (".spz",),
        _of("spz:read_spz"),
        options=frozenset({"spz_version"}),
    ),
    Format("sog", "pose", _of("sog:write"), (".sog",), _of("sog:read_sog")),
    Format(
        "usd",
        "sequence",
        _of("usd:write"),
        (".usd", ".usda", ".usdc", ".usdz"),
        _of("usd:read_usd"),
        check=_of("usd:check_usd"),
    ),
    Format(
        "gaussian-avatars",
        "folder",
        _of("gaussian_avatars:write"),
        from_files=False,
        refusals=dict.fromkeys(
            ("set", "series", "every"),
            "GaussianAvatars' folder holds every timestep; leave --set, --series and --every out",
        ),
    ),
)

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
