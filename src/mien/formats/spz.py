"""The .spz file: Gaussians in one pose (docs/splat_files.md)."""

from pathlib import Path

from mien import export
from mien.formats.format import Content, Format, Options, pose_words


def _write(path: Path, content: Content, options: Options) -> str:
    export.write_spz(path, content.pose(), options.spz_version)
    return pose_words(path, content)


SPZ = Format("spz", "pose", _write, (".spz",), lambda path: export.read_spz(path), options=frozenset({"spz_version"}))
