"""The .spz file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.gaussians import Gaussians


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_spz

    write_spz(path, content.pose())
    return f"{content.count:,} Gaussians"


def _read(path: Path) -> "Gaussians":
    from mien.export import read_spz

    return read_spz(path)


SPZ = Format("spz", "pose", _write, (".spz",), _read)
