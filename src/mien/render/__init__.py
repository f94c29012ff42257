"""render."""

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

__all__ = [
    "Headlight",
    "MeshFragments",
    "Texture",
    "interpolate",
    "rasterize_mesh",
    "render_mesh",
    "sample_texture",
    "sh_basis",
    "shade",
    "vertex_normals",
]
