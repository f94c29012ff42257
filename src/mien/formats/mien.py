"""The .mien file: all of an avatar (docs/avatar_file.md)."""

from pathlib import Path

from mien.formats.format import Content, Options
from mien.runtime.file import read_portable, write_portable

__all__ = ["read_portable", "write"]


def write(path: Path, content: Content, options: Options) -> str:
    """Write the avatar, and return what is told of it."""
    write_portable(path, content.portable(soft_cut=options.soft_cut))
    return f"{content.count:,} Gaussians, {path.stat().st_size / 1e6:.1f} MB"
