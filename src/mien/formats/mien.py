"""The .mien file: all of an avatar (docs/avatar_file.md)."""

from dataclasses import dataclass
from pathlib import Path

from mien.formats.format import Content, NoOptions
from mien.runtime.file import read_portable, write_portable

__all__ = ["MienOptions", "read_portable", "write"]


@dataclass(frozen=True)
class MienOptions(NoOptions):
    """Options of .mien files, which pages have as well."""

    sharp_cut: bool = False
    """The head ends sharply at the neck, as in training (default: it fades over 3 cm)."""


def write(path: Path, content: Content, options: MienOptions) -> str:
    """Write the avatar, and return what is told of it."""
    write_portable(path, content.portable(soft_cut=not options.sharp_cut))
    return f"{content.count:,} Gaussians, {path.stat().st_size / 1e6:.1f} MB"
