"""The .ply file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options, pose_words


def _write(path: Path, content: Content, options: Options) -> str:
    export.write_ply(path, content.pose(), options.sh)
    return pose_words(path, content)


PLY = Format("ply", "pose", _write, (".ply",), lambda path: export.read_ply(path), options=frozenset({"sh"}))
