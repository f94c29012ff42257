"""USD files: Gaussians in one pose, or every frame of a motion as a time sample (docs/splat_files.md)."""

from pathlib import Path
from typing import TYPE_CHECKING

from mien.export.usd_package import USD_ENDINGS, check_usd
from mien.formats.format import Content, Format, Options

if TYPE_CHECKING:
    from mien.gaussians import Gaussians


def _write(path: Path, content: Content, options: Options) -> str:
    from mien.export import write_usd

    moving = content.poses()
    if moving is None:
        write_usd(path, [content.pose()])
        return f"{content.count:,} Gaussians"
    count = write_usd(path, *moving)
    return f"{count} time samples, {path.stat().st_size / 1e6:.1f} MB"


def _read(path: Path) -> "Gaussians":
    from mien.export import read_usd

    return read_usd(path)


USD = Format("usd", "sequence", _write, USD_ENDINGS, _read, check=check_usd)
