"""Avatars and posed Gaussians as files for other programs, with a `read_*` beside each `write_*`."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.export.ply import read_ply, write_ply
    from mien.export.world_space import in_world
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "world_space": ["in_world"],
            "ply": ["read_ply", "write_ply"],
        },
    )

__all__ = ["in_world", "read_ply", "write_ply"]
