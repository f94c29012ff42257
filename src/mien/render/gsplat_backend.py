"""The CUDA back end: one view through gsplat's kernels, with the same interface as the other back ends."""

import math
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Camera
from mien.errors import UserError
from mien.gaussians import Gaussians, Rendering
from mien.render.projection import DILATION, NEAR
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
    if not torch.is_grad_enabled():  # A step of training asks its loss instead, and not every time (`mien.training`).
        check_finite(gaussians, camera, background)
    if len(gaussians) == 0:
        return _nothing(gaussians, camera, background, means2d_offset)
    if gaussians.means.is_cpu or gaussians.means.dtype != torch.float32:
        raise ValueError(
            f"rasterize: backend 'gsplat' takes float32 CUDA tensors, got {gaussians.means.dtype} on "
            f"{gaussians.means.device}; use backend='auto'"
        )
    from mien.render.around_gsplat import constant_colors, three_sigma, view_directions

    viewmats, Ks = camera.viewmat.contiguous()[None], camera.K.contiguous()[None]
    means, opacities, degree = gaussians.means.contiguous(), gaussians.opacities.contiguous(), _degree(gaussians)
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        means, *_shapes(gaussians), viewmats, Ks, camera.width, camera.height,
        eps2d=DILATION, near_plane=_NEAR, packed=False, opacities=opacities,
    )  # fmt: skip
    if degree == 0:
        colors = constant_colors(gaussians.sh)
    else:
        directions = view_directions(means, camera.viewmat)
        colors = gsplat.spherical_harmonics(degree, directions, gaussians.sh.contiguous()[None])
        colors = torch.relu(colors + 0.5)
    columns, rows = math.ceil(camera.width / _TILE), math.ceil(camera.height / _TILE)
    _, intersections, flat_ids = gsplat.isect_tiles(
        means2d, radii, depths, _TILE, columns, rows, packed=False, n_images=1
    )
    offsets = gsplat.isect_offset_encode(intersections, 1, columns, rows).reshape(1, rows, columns)
    image, alpha = gsplat.rasterize_to_pixels(
        means2d + means2d_offset, conics, colors, opacities[None], camera.width, camera.height, _TILE, offsets,
        flat_ids, backgrounds=background.contiguous()[None],
    )  # fmt: skip
    reach = three_sigma(conics, means2d, opacities, radii, camera.width, camera.height)
    # Views whose gradients are views, too: an index would fill zeros.
    return Rendering(image.squeeze(0), alpha.squeeze(0).squeeze(-1), reach, means2d_offset)


def _degree(gaussians: Gaussians) -> int:
    return math.isqrt(gaussians.sh.shape[-2]) - 1


def _shapes(gaussians: Gaussians) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Covariances alone, or quaternions and scales, as gsplat takes them."""
    if gaussians.covariances is not None:
        return gaussians.covariances.contiguous(), None, None
    return None, gaussians.quats.contiguous(), gaussians.scales.contiguous()


def _nothing(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], means2d_offset: Float[Tensor, "0 2"]
) -> Rendering:
    """The background alone, because gsplat's kernels divide by the number of Gaussians."""
    zero = 0 * (gaussians.means.sum() + means2d_offset.sum())
    image = background.expand(camera.height, camera.width, 3) + zero
    alpha = background.new_zeros(camera.height, camera.width) + zero
    return Rendering(image, alpha, torch.zeros(0, dtype=torch.int32, device=background.device), means2d_offset)


def _import_gsplat() -> ModuleType:
    try:
        import gsplat  # pyright: ignore[reportMissingImports]  # an optional package
    except ImportError as error:
        remedy = "install it with `.venv/bin/uv pip install gsplat==1.5.3`"
        raise UserError(f"rendering on a GPU needs gsplat: {remedy}") from error
    return gsplat
