"""Pictures of Gaussians and of meshes, with gradients, and camera paths."""

from mien.gaussians import Rendering
from mien.render.rasterize import rasterize

__all__ = ["Rendering", "rasterize"]
