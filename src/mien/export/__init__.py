"""Avatars and posed Gaussians as files for other programs, with a `read_*` beside each `write_*`."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.export.gaussian_avatars_folder import (
        GaussianAvatarsFolder,
        read_gaussian_avatars_folder,
        write_gaussian_avatars_folder,
    )
    from mien.export.ply import read_ply, write_ply
    from mien.export.world_space import in_world
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "gaussian_avatars_folder": [
                "GaussianAvatarsFolder", "read_gaussian_avatars_folder", "write_gaussian_avatars_folder",
            ],
            "world_space": ["in_world"],
            "ply": ["read_ply", "write_ply"],
        },
    )  # fmt: skip

__all__ = [
    "GaussianAvatarsFolder",
    "in_world",
    "read_gaussian_avatars_folder",
    "read_ply",
    "write_gaussian_avatars_folder",
    "write_ply",
]
