"""The rasterizer in plain PyTorch, for any dtype and device. It is slow, and the reference for all other back ends."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians, Rendering
from mien.render.projection import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, Splats, project_splats
from mien.render.validation import check_finite

_TILE = 32
"""Side of a tile in pixels, small enough that the dense [gaussians, pixels] tables of one tile fit in memory."""


def render_reference(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], means2d_offset: Float[Tensor, "n 2"]
) -> Rendering:
    """Render one view of unbatched Gaussians, given in the camera's world.

    Autograd makes it differentiable in the Gaussians, the background, `means2d_offset`, `camera.viewmat` and
    `camera.K`.
    """
    check_finite(gaussians, camera, background)
    splats = project_splats(gaussians, camera, means2d_offset)
    drawn = splats.drawn.nonzero()[:, 0]
    order = drawn[torch.argsort(splats.depths.detach()[drawn], stable=True)]
    rows = []
    for top in range(0, camera.height, _TILE):
        tiles = []
        for left in range(0, camera.width, _TILE):
            ys = torch.arange(top, min(top + _TILE, camera.height)).to(background) + 0.5
            xs = torch.arange(left, min(left + _TILE, camera.width)).to(background) + 0.5
            tiles.append(_blend(splats, _overlapping(splats, order, xs, ys), xs, ys, background))
        rows.append(torch.cat(tiles, dim=1))
    rgba = torch.cat(rows)
    return Rendering(rgba[..., :3], rgba[..., 3], splats.radii(), means2d_offset)


def _overlapping(splats: Splats, order: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Indices, front to back, of the splats that can reach the pixels of a tile."""
    center, extent = splats.means2d.detach()[order], splats.extents[order]
    first, last = torch.stack([xs[0], ys[0]]), torch.stack([xs[-1], ys[-1]])
    return order[((center + extent >= first) & (center - extent <= last)).all(-1)]


def _blend(
    splats: Splats, chosen: Tensor, xs: Float[Tensor, " w"], ys: Float[Tensor, " h"], background: Float[Tensor, " 3"]
) -> Float[Tensor, "h w 4"]:
    """RGB over the background and alpha of one tile. `chosen` lists its splats from front to back."""
    xx, xy, yy = splats.covariances[chosen].unbind(-1)
    determinant = xx * yy - xy * xy
    dx = xs[None, None, :] - splats.means2d[chosen, 0, None, None]
    dy = ys[None, :, None] - splats.means2d[chosen, 1, None, None]
    conic = torch.stack([yy, -xy, xx], -1) / determinant[:, None]
    a, b, c = conic[:, :, None, None].unbind(1)
    exponent = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = torch.clamp_max(splats.opacities[chosen, None, None] * torch.exp(-exponent), MAX_ALPHA)
    alpha = torch.where(alpha < MIN_ALPHA, 0, alpha)
    # Transmittance only falls, so the test also fails for all Gaussians behind the one that ends the pixel.
    blended = torch.cumprod(1 - alpha.detach(), dim=0) > MIN_TRANSMITTANCE
    alpha = torch.where(blended, alpha, 0)
    transmittance = torch.cumprod(torch.cat([alpha.new_ones(1, len(ys), len(xs)), 1 - alpha]), 0)
    weights = alpha * transmittance[:-1]
    color = torch.einsum("nhw,nc->hwc", weights, splats.colors[chosen])
    remaining = transmittance[-1][..., None]
    return torch.cat([color + remaining * background, 1 - remaining], -1)
