"""The CUDA back end: one view through gsplat's kernels, with the same interface as the other back ends."""

import math
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.camera import Camera
from mien.errors import UserError
from mien.gaussians import Gaussians, Rendering
from mien.render.projection import DILATION, MIN_ALPHA, NEAR
from mien.render.validation import check_finite

_TILE = 16
"""Side of a tile in pixels, for which gsplat's kernels are tuned."""
_NEAR = float(np.nextafter(np.float32(NEAR), np.float32(1)))
"""The next depth after NEAR: gsplat draws what is at its near plane, and the other back ends do not."""


def render_gsplat(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], means2d_offset: Float[Tensor, "n 2"]
) -> Rendering:
    """Render one view of unbatched CUDA Gaussians, given in the camera's world.

    It calls gsplat's single steps instead of its `rasterization`, because `means2d_offset` is added between projection
    and blending, where it collects the gradient of the centres.
    """
    gsplat = _import_gsplat()
    if len(gaussians) == 0:
        return _nothing(gaussians, camera, background, means2d_offset)
    if not gaussians.means.is_cuda or gaussians.means.dtype != torch.float32:
        raise ValueError(
            f"rasterize: backend 'gsplat' takes float32 CUDA tensors, got {gaussians.means.dtype} on "
            f"{gaussians.means.device}; use backend='auto'"
        )
    viewmats, Ks = camera.viewmat[None].contiguous(), camera.K[None].contiguous()
    means, quats, scales = (t.contiguous() for t in (gaussians.means, gaussians.quats, gaussians.scales))
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        means, None, quats, scales, viewmats, Ks, camera.width, camera.height,
        eps2d=DILATION, near_plane=_NEAR, packed=False, opacities=gaussians.opacities.contiguous(),
    )  # fmt: skip
    camera_position = -(camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3])
    visible = (radii > 0).all(-1)
    degree = math.isqrt(gaussians.sh.shape[-2]) - 1
    directions = (means - camera_position)[None]
    colors = gsplat.spherical_harmonics(degree, directions, gaussians.sh[None].contiguous(), masks=visible)
    # The next step makes the host wait for the number of pairs anyway, so this check costs almost nothing here.
    check_finite(gaussians, camera, background)
    columns, rows = math.ceil(camera.width / _TILE), math.ceil(camera.height / _TILE)
    _, intersections, flat_ids = gsplat.isect_tiles(
        means2d, radii, depths, _TILE, columns, rows, packed=False, n_images=1
    )
    offsets = gsplat.isect_offset_encode(intersections, 1, columns, rows).reshape(1, rows, columns)
    image, alpha = gsplat.rasterize_to_pixels(
        means2d + means2d_offset, conics, torch.clamp_min(colors + 0.5, 0), gaussians.opacities[None].contiguous(),
        camera.width, camera.height, _TILE, offsets, flat_ids, backgrounds=background[None].contiguous(),
    )  # fmt: skip
    radii = _three_sigma(conics[0], means2d[0], gaussians.opacities, visible[0], camera)
    return Rendering(image[0], alpha[0, ..., 0], radii, means2d_offset)


def _nothing(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], means2d_offset: Float[Tensor, "0 2"]
) -> Rendering:
    """The background alone, because gsplat's kernels divide by the number of Gaussians."""
    check_finite(gaussians, camera, background)
    zero = 0 * (gaussians.means.sum() + means2d_offset.sum())
    image = background.expand(camera.height, camera.width, 3) + zero
    alpha = background.new_zeros(camera.height, camera.width) + zero
    return Rendering(image, alpha, torch.zeros(0, dtype=torch.int32, device=background.device), means2d_offset)


@torch.no_grad()
def _three_sigma(
    conics: Float[Tensor, "n 3"],
    means2d: Float[Tensor, "n 2"],
    opacities: Float[Tensor, " n"],
    visible: Bool[Tensor, " n"],
    camera: Camera,
) -> Int[Tensor, " n"]:
    """3 sigma of the longer axis in pixels; 0 for Gaussians that reach no pixel.

    gsplat's own radii are boxes that depend on opacity. They are rounded up, so some of them reach into the picture
    although their Gaussians do not. `project_splats` has the exact test, which is repeated here.
    """
    xx, xy, yy = conics.unbind(-1)
    smallest = 0.5 * (xx + yy) - torch.sqrt(0.25 * (xx - yy) ** 2 + xy**2)  # Eigenvalue of the inverse covariance.
    radii = torch.ceil(3 / smallest.clamp_min(1e-12).sqrt())
    variances = torch.stack([yy, xx], -1) / (xx * yy - xy**2)[:, None]
    extents = torch.sqrt(2 * torch.log(opacities / MIN_ALPHA).clamp_min(0)[:, None] * variances)
    low, high = means2d - extents, means2d + extents
    inside = (high > 0).all(-1) & (low[:, 0] < camera.width) & (low[:, 1] < camera.height)
    return torch.where(visible & inside, radii, 0).to(torch.int32)


def _import_gsplat() -> ModuleType:
    try:
        import gsplat  # pyright: ignore[reportMissingImports]  # an optional package
    except ImportError as error:
        remedy = "install it with `.venv/bin/uv pip install gsplat==1.5.3`"
        raise UserError(f"rendering on a GPU needs gsplat: {remedy}") from error
    return gsplat
