"""The .ply file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.gaussians import Gaussians


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_ply

    write_ply(path, content.pose(), options.sh)
    return f"{content.count:,} Gaussians"


def _read(path: Path) -> "Gaussians":
    from mien.export import read_ply

    return read_ply(path)


PLY = Format("ply", "pose", _write, (".ply",), _read, options=frozenset({"sh"}))
