"""The photometric loss of Gaussian splatting: L1 and SSIM (Wang et al. 2004; Kerbl et al. 2023, section 5)."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from mien import _native
from mien.arrays import is_native, recycled, unpacked
from mien.media.pictures import Box

WINDOW_RADIUS = 5
"""Radius of the SSIM window in pixels: it is 11x11."""
WINDOW_SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
"""Constants of SSIM for colours in 0..1 (Wang et al. 2004)."""
_NATIVE_MIN_WIDTH = 6


def photometric_loss(
    image: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"],
    l1_weight: float = 0.8,
    ssim_weight: float = 0.2,
    box: Box | None = None,
    drawn: Float[Tensor, "h w"] | None = None,
    parts: Sequence[Box] = (),
    part_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """`l1_weight` * mean |image - target| + `ssim_weight` * (1 - mean SSIM), fused and native on a CPU.

    Differentiable in `image`. A uint8 `target` has colours 0..255. With a `box`, pixels outside count as equal in both
    pictures, although the windows of pixels inside still see them, and the means stay over the whole picture. Value and
    gradient are the same as without the box, in a fraction of the time, if the pictures differ only where they are at
    least 5 pixels inside the box. `drawn` promises that the pictures are equal where it is 0 and outside the box; the
    native loss skips these pixels. Each box in `parts` counts again, with `part_weight`, as the same loss of both
    pictures cut to the box, but divided by the pixels of the whole picture: a pixel has the same weight in all boxes.
    """
    assert image.shape == target.shape, (image.shape, target.shape)
    assert not target.requires_grad
    if not is_native(image, target) or image.shape[1] < _NATIVE_MIN_WIDTH:
        return photometric_loss_reference(
            image, target, l1_weight, ssim_weight, box if drawn is None else None, parts, part_weight
        )
    boxes = [_clipped(part, image) for part in parts if part_weight > 0]
    return _PhotometricLoss.apply(
        image, target, _clipped(box, image), drawn, (l1_weight, ssim_weight), boxes, part_weight
    )


def photometric_loss_reference(
    image: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"] | UInt8[Tensor, "h w 3"],
    l1_weight: float = 0.8,
    ssim_weight: float = 0.2,
    box: Box | None = None,
    parts: Sequence[Box] = (),
    part_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """`photometric_loss` in plain PyTorch, for any dtype and device."""
    target = target.to(image) / 255 if target.dtype == torch.uint8 else target
    inside = _slices(_clipped(box, image))
    difference = (image - target)[inside].abs()
    unlikeness = 1 - differentiable_ssim_map(image, target)[inside]
    loss = (l1_weight * difference.sum() + ssim_weight * unlikeness.sum()) / image.numel()
    for part in parts if part_weight > 0 else ():
        rows, columns = _slices(_clipped(part, image))
        cut = photometric_loss_reference(image[rows, columns], target[rows, columns], l1_weight, ssim_weight)
        loss = loss + part_weight * cut * (image[rows, columns].numel() / image.numel())
    return loss


def differentiable_ssim_map(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, "h w c"]:
    """Structural similarity of two pictures (0..1) at every pixel, at most 1. Windows see zeros beyond the border.

    `mien.evaluation.metrics.ssim_map` computes the same for scores, faster on a CPU and without gradients.
    """
    statistics = (image, target, image * image, target * target, image * target)
    mean_x, mean_y, square_x, square_y, product = _blur(torch.stack(statistics))
    variance_x, variance_y = square_x - mean_x * mean_x, square_y - mean_y * mean_y
    covariance = product - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    return numerator / ((mean_x * mean_x + mean_y * mean_y + C1) * (variance_x + variance_y + C2))


class _PhotometricLoss(torch.autograd.Function):
    """One native pass computes value and gradient; `backward` only scales the gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        box: Box,
        drawn: Tensor | None,
        weights: tuple[float, float],
        parts: Sequence[Box],
        part_weight: float,
    ) -> Tensor:
        gradient = recycled(*image.shape) if ctx.needs_input_grad[0] else None
        drawn = None if drawn is None else drawn.detach().contiguous()
        loss = torch.empty(())
        pictures = unpacked(image.detach().contiguous(), target.contiguous(), drawn, gradient, loss)
        _native.photometric_loss(box, weights, *pictures)
        for part in parts:
            loss += _add_part(part, image.detach(), target, weights, part_weight, gradient)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient if float(grad_loss) == 1 else gradient * grad_loss, *[None] * 6


def _add_part(
    part: Box,
    image: Float[Tensor, "h w 3"],
    target: Tensor,
    weights: tuple[float, float],
    part_weight: float,
    gradient: Float[Tensor, "h w 3"] | None,
) -> Float[Tensor, ""]:
    """The weighted loss of the pictures cut to a box. Its gradient is added to that of the whole picture."""
    _, _, width, height = part
    loss = torch.zeros(())
    if width < _NATIVE_MIN_WIDTH or height < 1:
        return loss
    rows, columns = _slices(part)
    cut = image[rows, columns].contiguous()
    own = None if gradient is None else torch.empty_like(cut)
    share = part_weight * cut.numel() / image.numel()
    pictures = unpacked(cut, target[rows, columns].contiguous(), None, own, loss)
    _native.photometric_loss((0, 0, width, height), (weights[0] * share, weights[1] * share), *pictures)
    if gradient is not None and own is not None:
        gradient[rows, columns] += own
    return loss


def _slices(box: Box) -> tuple[slice, slice]:
    """The rows and the columns of a box."""
    left, top, width, height = box
    return slice(top, top + height), slice(left, left + width)


def _blur(images: Float[Tensor, "s h w c"]) -> Float[Tensor, "s h w c"]:
    distances = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=images.dtype, device=images.device)
    window = (-(distances**2) / (2 * WINDOW_SIGMA**2)).exp()
    window = window / window.sum()
    planes = images.movedim(-1, 1).flatten(0, 1)[:, None]
    planes = conv2d(planes, window[None, None, :, None], padding=(WINDOW_RADIUS, 0))
    planes = conv2d(planes, window[None, None, None, :], padding=(0, WINDOW_RADIUS))
    return planes.view(len(images), -1, *images.shape[1:3]).movedim(1, -1)


def _clipped(box: Box | None, image: Tensor) -> Box:
    """The part of the box inside the picture; width or height 0 if there is none."""
    height, width = image.shape[:2]
    if box is None:
        return 0, 0, width, height
    left, top = min(max(box[0], 0), width), min(max(box[1], 0), height)
    right, bottom = min(box[0] + box[2], width), min(box[1] + box[3], height)
    return left, top, max(right - left, 0), max(bottom - top, 0)
