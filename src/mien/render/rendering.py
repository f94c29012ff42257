"""The result of a rasterizer."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians

View = tuple[Gaussians, Camera]
"""Unbatched Gaussians in the camera's world, and the camera."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """One picture, or a batch of them with a leading axis."""

    image: Float[Tensor, "*b h w 3"]
    """RGB over the background, not clamped from above."""
    alpha: Float[Tensor, "*b h w"]
    """Opacity of all Gaussians together, 0..1."""
    radii: Int[Tensor, "*b n"]
    """Extent on screen in pixels (3 sigma of the 2D Gaussian's longer axis, rounded up); 0 where not drawn."""
    means2d_offset: Float[Tensor, "*b n 2"]
    """Zeros added to the projected centres. After `backward()` its `.grad` is the gradient of the loss with respect to
    the centres in pixels, which density control reads."""
    depth: Float[Tensor, "*b h w"] | None = None
    """Expected depth along the camera's z axis in metres, 0 in empty pixels; None unless requested. Differentiable."""
