"""The CPU rasterizer: autograd around the C++ core (native/README.md has its algorithm)."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.camera import Camera
from mien.gaussians import Gaussians
from mien.render.rendering import Rendering
from mien.render.validation import check_finite


def render_native(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, " 3"], means2d_offset: Float[Tensor, "n 2"]
) -> Rendering:
    """One view of unbatched float32 CPU Gaussians given in the camera's world.

    Differentiable in the Gaussians, the background, `means2d_offset` (whose values are not read), `camera.viewmat`
    and `camera.K`. The result does not depend on the number of threads.
    """
    means = gaussians.means
    if means.is_cuda or means.dtype != torch.float32:
        raise ValueError(
            f"rasterize: backend 'native' takes float32 CPU tensors, got {means.dtype} on {means.device}; "
            "use backend='auto'"
        )
    parameters = (means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    inputs = (*parameters, background, camera.viewmat, camera.K)
    size = (camera.height, camera.width)
    try:
        image, alpha, radii = _Rasterize.apply(size, means2d_offset, *(t.contiguous() for t in inputs))  # pyright: ignore[reportGeneralTypeIssues]
    except _NotFiniteError:
        check_finite(gaussians, camera, background)
        raise
    return Rendering(image, alpha, radii, means2d_offset)


class _NotFiniteError(ValueError):
    """A NaN or an infinity, not yet named."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, size: tuple[int, int], means2d_offset: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, sh, background, viewmat, K = (tensor.detach() for tensor in inputs)
        image, alpha = means.new_empty(*size, 3), means.new_empty(size)
        radii = torch.empty(len(means), dtype=torch.int32)
        frame = _native.rasterize_forward(
            means, quats, scales, opacities, sh, background, viewmat, K, image, alpha, radii
        )  # fmt: skip
        if frame is None:
            raise _NotFiniteError("rasterize: NaN or infinity in an input")
        ctx.frame = frame
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        ctx.save_for_backward(*inputs[:5], image, alpha)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None, _: None) -> tuple[Tensor | None, ...]:
        means, quats, scales, opacities, sh, image, alpha = ctx.saved_tensors
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        parameters = (means, quats, scales, opacities, sh)
        grad_means, grad_quats, grad_scales, grad_opacities, grad_sh = (torch.empty_like(t) for t in parameters)
        grad_means2d, grad_view = means.new_empty(len(means), 2), means.new_empty(16)
        _native.rasterize_backward(
            ctx.frame, means, quats, scales, opacities, sh, image, alpha, grad_image, grad_alpha,
            grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_means2d, grad_view,
        )  # fmt: skip
        needs_background, needs_viewmat, needs_K = ctx.needs_input_grad[7:]
        grad_background = torch.einsum("hwc,hw->c", grad_image, 1 - alpha) if needs_background else None
        grad_viewmat = _viewmat_gradient(grad_view) if needs_viewmat else None
        grad_K = _intrinsics_gradient(grad_view) if needs_K else None
        grad_parameters = (grad_means, grad_quats, grad_scales, grad_opacities, grad_sh)
        return (None, grad_means2d, *grad_parameters, grad_background, grad_viewmat, grad_K)


# The kernel's gradient of the view: rotation [9], translation [3], fx, fy, cx, cy.
def _viewmat_gradient(grad_view: Float[Tensor, " 16"]) -> Float[Tensor, "4 4"]:
    top = torch.cat([grad_view[:9].reshape(3, 3), grad_view[9:12, None]], 1)
    return torch.cat([top, torch.zeros_like(top[:1])])


def _intrinsics_gradient(grad_view: Float[Tensor, " 16"]) -> Float[Tensor, "3 3"]:
    grad_K = grad_view.new_zeros(3, 3)
    grad_K[[0, 1, 0, 1], [0, 1, 2, 2]] = grad_view[12:]
    return grad_K
