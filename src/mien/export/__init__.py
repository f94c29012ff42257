"""Avatars and posed Gaussians as files for other programs: `write_*` and `read_*` side by side."""

from mien.export.frames import in_world
from mien.export.ply import read_ply, write_ply

__all__ = ["in_world", "read_ply", "write_ply"]
