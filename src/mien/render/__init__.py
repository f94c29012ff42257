"""Pictures of Gaussians and of meshes, with gradients, and camera paths."""

from mien.render.rasterize import rasterize
from mien.render.rendering import Rendering

__all__ = ["Rendering", "rasterize"]
