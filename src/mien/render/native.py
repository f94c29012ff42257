"""The CPU rasterizer: autograd around the C++ core (native/README.md describes the algorithm)."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien import _native
from mien.arrays import left_to_autograd, recycled, recycled_like, recycled_twice, unpacked
from mien.camera import Camera
from mien.gaussians import Gaussians, Rendering
from mien.render.validation import TooManyPairsError, check_finite

View = tuple[Gaussians, Camera]
"""Unbatched Gaussians in the camera's world, and the camera."""
_TOO_MANY_PAIRS = "too many pairs"
"""Start of the native core's message for this error (`native/rasterize_bin.cpp`)."""
_INPUTS = 9
"""Number of tensors per view: offset of the centres, means, quats, scales, opacities, sh, background, viewmat, K."""


def render_native(
    views: Sequence[View], backgrounds: Sequence[Float[Tensor, " 3"]], means2d_offsets: Sequence[Float[Tensor, "n 2"]]
) -> list[Rendering]:
    """Render views of unbatched float32 CPU Gaussians, given in their camera's world. Each of several gets one thread.

    The result is differentiable in the Gaussians, the backgrounds, `means2d_offsets` (their values are not read),
    `camera.viewmat` and `camera.K`. It does not depend on the number of threads.
    """
    inputs: list[Tensor] = []
    for (gaussians, camera), background, offset in zip(views, backgrounds, means2d_offsets, strict=True):
        means = gaussians.means
        if means.is_cuda or means.dtype != torch.float32:
            raise ValueError(
                f"rasterize: backend 'native' takes float32 CPU tensors, got {means.dtype} on {means.device}; "
                "use backend='auto'"
            )
        own = (means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
        inputs += (offset, *(t.contiguous() for t in (*own, background, camera.viewmat, camera.K)))
    if not torch.is_grad_enabled():
        inputs = [tensor.detach() for tensor in inputs]
    sizes = [(camera.height, camera.width) for _, camera in views]
    try:
        outputs: tuple[Tensor, ...] = _Rasterize.apply(sizes, *inputs)  # pyright: ignore[reportAssignmentType]
    except _NotFiniteError as error:
        check_finite(*views[error.view], backgrounds[error.view])
        raise
    return [
        Rendering(*outputs[3 * index : 3 * index + 3], means2d_offset=offset)
        for index, offset in enumerate(means2d_offsets)
    ]


class _NotFiniteError(ValueError):
    """A NaN or an infinity in one of the views. `check_finite` then names the tensor."""

    def __init__(self, view: int):
        super().__init__("rasterize: NaN or infinity in an input")
        self.view = view


class _Rasterize(torch.autograd.Function):
    """Takes `_INPUTS` tensors per view and returns image, alpha and radii of each view."""

    @staticmethod
    def forward(ctx: Any, sizes: list[tuple[int, int]], *inputs: Tensor) -> tuple[Tensor, ...]:
        outputs, tasks, kept, pictures = [], [], [], []
        for index, size in enumerate(sizes):
            own = inputs[_INPUTS * index + 1 : _INPUTS * (index + 1)]
            kept += own[:5]
            count = len(own[0])
            (image, kept_image), (alpha, kept_alpha) = recycled_twice((*size, 3)), recycled_twice(size)
            pictures += (kept_image, kept_alpha)
            view = (image, alpha, torch.empty(count, dtype=torch.int32))
            known = unpacked(*own, *view)
            tasks.append(_native.RasterizeView(_native.GaussianArrays(*known[:5]), *known[5:]))
            outputs += view
        try:
            ctx.frames = _native.rasterize_views(tasks, any(ctx.needs_input_grad))
        except ValueError as error:
            if str(error).startswith(_TOO_MANY_PAIRS):
                raise TooManyPairsError(str(error)) from None
            raise
        if None in ctx.frames:
            raise _NotFiniteError(ctx.frames.index(None))
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*outputs[2::3])
        # PyTorch would make a tensor of each that it saves.
        ctx.offsets, ctx.kept, ctx.pictures = inputs[::_INPUTS], kept, pictures
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        views, tasks = [], []
        for index, frame in enumerate(ctx.frames):
            own = ctx.kept[5 * index : 5 * index + 5]
            image, alpha = ctx.pictures[2 * index : 2 * index + 2]
            grad_image, grad_alpha, _ = gradients[3 * index : 3 * index + 3]
            grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
            grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
            found = [recycled_like(t) for t in own]
            of_view = [recycled(len(own[0]), 2), recycled(4, 4), recycled(3, 3)]
            known = unpacked(image, alpha, grad_image, grad_alpha, *own, *found, *of_view)
            gaussians, of_gaussians = _native.GaussianArrays(*known[4:9]), _native.GaussianArrays(*known[9:14])
            shown = known[0], known[1], known[2], known[3]  # image, alpha and their gradients
            tasks.append(_native.RasterizeGradients(frame, gaussians, *shown, of_gaussians, *known[14:]))
            views.append((grad_image, alpha, *found, *of_view))
        _native.rasterize_views_backward(tasks)
        result: list[Tensor | None] = [None]
        for index, (grad_image, alpha, *found) in enumerate(views):
            *grad_parameters, grad_means2d, grad_viewmat, grad_K = found
            (grad_means2d,) = left_to_autograd([ctx.offsets[index]], [grad_means2d])
            needs_background, needs_viewmat, needs_K = ctx.needs_input_grad[1 + _INPUTS * index + 6 :][:3]
            result += (grad_means2d, *grad_parameters)
            result.append(torch.einsum("hwc,hw->c", grad_image, 1 - alpha) if needs_background else None)
            result += (grad_viewmat if needs_viewmat else None, grad_K if needs_K else None)
        return tuple(result)
