"""The .sog file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.gaussians import Gaussians


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_sog

    write_sog(path, content.pose())
    return f"{content.count:,} Gaussians"


def _read(path: Path) -> "Gaussians":
    from mien.export import read_sog

    return read_sog(path)


SOG = Format("sog", "pose", _write, (".sog",), _read)
