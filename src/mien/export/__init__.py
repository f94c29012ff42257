"""Avatars and posed Gaussians as files for other programs, with a `read_*` beside each `write_*`."""

from typing import TYPE_CHECKING

from mien.lazy import lazy_names

if TYPE_CHECKING:
    from mien.export.gaussian_avatars_folder import (
        GaussianAvatarsFolder,
        read_gaussian_avatars_folder,
        write_gaussian_avatars_folder,
    )
    from mien.export.glb import MeshModel, WrittenGlb, write_glb
    from mien.export.glb_avatar import read_glb_avatar
    from mien.export.page_head import Described
    from mien.export.ply import read_ply, write_ply
    from mien.export.sog import read_sog, write_sog
    from mien.export.spz import read_spz, write_spz
    from mien.export.usd import read_usd, write_usd
    from mien.export.vrm import write_vrm
    from mien.export.web_page import WrittenPage, write_packed, write_page
    from mien.formats.shared.flame_params import face_of_flame_params, flame_params_of
    from mien.formats.shared.glb_file import Glb, read_glb
    from mien.formats.shared.packed import Motion, pack, unpacked
    from mien.formats.shared.webcam import WebcamFiles, find_webcam_files
    from mien.formats.shared.world_space import in_world
    from mien.media.pixels import png_bytes, to_rgb
else:
    __getattr__, __dir__ = lazy_names(__name__, __file__)

__all__ = [
    "Described",
    "GaussianAvatarsFolder",
    "Glb",
    "MeshModel",
    "Motion",
    "WebcamFiles",
    "WrittenGlb",
    "WrittenPage",
    "face_of_flame_params",
    "find_webcam_files",
    "flame_params_of",
    "in_world",
    "pack",
    "png_bytes",
    "read_gaussian_avatars_folder",
    "read_glb",
    "read_glb_avatar",
    "read_ply",
    "read_sog",
    "read_spz",
    "read_usd",
    "to_rgb",
    "unpacked",
    "write_gaussian_avatars_folder",
    "write_glb",
    "write_packed",
    "write_page",
    "write_ply",
    "write_sog",
    "write_spz",
    "write_usd",
    "write_vrm",
]
