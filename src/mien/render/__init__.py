"""Pictures of Gaussians and of meshes, with gradients, and camera paths."""

from mien.render.camera_paths import orbit, sway, turntable
from mien.render.closing import close_holes
from mien.render.mesh import (
    Headlight,
    MeshFragments,
    Texture,
    interpolate,
    rasterize_mesh,
    render_mesh,
    sample_texture,
    sh_basis,
    shade,
    vertex_normals,
)
from mien.render.rasterize import rasterize
from mien.render.rendering import Rendering

__all__ = [
    "Rendering",
    "Headlight",
    "MeshFragments",
    "Texture",
    "close_holes",
    "interpolate",
    "orbit",
    "rasterize",
    "rasterize_mesh",
    "render_mesh",
    "sample_texture",
    "sh_basis",
    "shade",
    "sway",
    "turntable",
    "vertex_normals",
]
