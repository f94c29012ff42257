"""USD files: Gaussians in one pose, or every frame of a motion as a time sample (docs/splat_files.md)."""

from pathlib import Path

from mien import export
from mien.export.usd_package import USD_ENDINGS, check_usd
from mien.formats.format import Content, Format, Options, pose_words


def _write(path: Path, content: Content, options: Options) -> str:
    moving = content.poses()
    if moving is None:
        export.write_usd(path, [content.pose()])
        return pose_words(path, content)
    count = export.write_usd(path, *moving)
    return f"{count} time samples, {path.stat().st_size / 1e6:.1f} MB"


USD = Format("usd", "sequence", _write, USD_ENDINGS, lambda path: export.read_usd(path), check=check_usd)
