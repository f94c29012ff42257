"""The .mien file: all of an avatar (docs/avatar_file.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.runtime.baked import PortableAvatar

_WHOLE = "a .mien file holds every expression; leave --set and --series out"


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.runtime.file import write_portable

    write_portable(path, content.portable(soft_cut=options.soft_cut))
    return f"{content.count:,} Gaussians, {path.stat().st_size / 1e6:.1f} MB"


def _read(path: Path) -> "PortableAvatar":
    from mien.runtime.file import read_portable

    return read_portable(path)


MIEN = Format(
    "mien",
    "avatar",
    _write,
    (".mien",),
    _read,
    options=frozenset({"soft_cut"}),
    refusals={"set": _WHOLE, "series": _WHOLE},
)
