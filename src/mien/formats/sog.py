"""The .sog file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options, pose_words


def _write(path: Path, content: Content, options: Options) -> str:
    export.write_sog(path, content.pose())
    return pose_words(path, content)


SOG = Format("sog", "pose", _write, (".sog",), lambda path: export.read_sog(path))
