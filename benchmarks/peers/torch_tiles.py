"""Draw Gaussians in a plain PyTorch loop over tiles, with autograd, as one would without a native core.

`compare.py` measures it: python benchmarks/peers/compare.py

Tiles of 16x16 pixels and boxes of 3 standard deviations, as in the original CUDA scheme (Kerbl et al. 2023).
"""

import torch
from torch import Tensor

from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render.projection import MAX_ALPHA, MIN_ALPHA, project_splats

TILE = 16


def render_tiles(gaussians: Gaussians, camera: Camera, background: Tensor) -> Tensor:
    """Return the picture [h, w, 3], differentiable in the Gaussians."""
    splats = project_splats(gaussians, camera, torch.zeros(len(gaussians), 2))
    order = splats.drawn.nonzero()[:, 0]
    order = order[splats.depths.detach()[order].argsort()]
    centers, colors = splats.means2d[order], splats.colors[order]
    opacities = splats.opacities[order]
    xx, xy, yy = splats.covariances[order].unbind(-1)
    determinant = xx * yy - xy * xy
    conics = torch.stack([yy, -xy, xx], -1) / determinant[:, None]
    reach = 3 * torch.stack([xx, yy], -1).detach().sqrt()
    low, high = (centers.detach() - reach) / TILE, (centers.detach() + reach) / TILE
    rows = []
    for row in range((camera.height + TILE - 1) // TILE):
        in_row = ((low[:, 1] < row + 1) & (high[:, 1] > row)).nonzero()[:, 0]
        tiles = []
        for column in range((camera.width + TILE - 1) // TILE):
            chosen = in_row[(low[in_row, 0] < column + 1) & (high[in_row, 0] > column)]
            xs = torch.arange(column * TILE, min((column + 1) * TILE, camera.width)) + 0.5
            ys = torch.arange(row * TILE, min((row + 1) * TILE, camera.height)) + 0.5
            weights, remaining = _weights(centers[chosen], conics[chosen], opacities[chosen], xs, ys)
            tiles.append(torch.einsum("nhw,nc->hwc", weights, colors[chosen]) + remaining[..., None] * background)
        rows.append(torch.cat(tiles, dim=1))
    return torch.cat(rows)


def _weights(centers: Tensor, conics: Tensor, opacities: Tensor, xs: Tensor, ys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights of splats in pixels, front to back [n, h, w], and the transmittance behind all [h, w]."""
    dx = xs[None, None, :] - centers[:, 0, None, None]
    dy = ys[None, :, None] - centers[:, 1, None, None]
    a, b, c = conics[:, :, None, None].unbind(1)
    alpha = opacities[:, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha < MIN_ALPHA, 0, alpha.clamp_max(MAX_ALPHA))
    through = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([through.new_ones(1, *through.shape[1:]), through])
    return alpha * before[:-1], before[-1]
