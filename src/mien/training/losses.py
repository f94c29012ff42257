"""Losses that compare a rendering with its target. They are pure functions, and means over the whole picture.

The photometric loss is that of Gaussian splatting: L1 and SSIM (Wang et al. 2004; Kerbl et al. 2023, section 5).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from mien import _native
from mien.arrays import is_native, native, recycled, recycled_like, times, unpacked
from mien.avatar.settings import PerceptualLoss, Photometric
from mien.camera import Box
from mien.gaussians import Rendering
from mien.kernels import on_gpu
from mien.perceptual.features import TrainingFeatures, load_training_features
from mien.training.footage.sequence import Target

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
    if on_gpu(image, target):
        from mien.training.losses_gpu import photometric_loss as on_device

        own = [clipped for part in parts if part_weight > 0 and min((clipped := _clipped(part, image))[2:]) > 0]
        return on_device(image, target, (l1_weight, ssim_weight), _clipped(box, image), own, part_weight)
    if not is_native(image, target) or image.shape[1] < _NATIVE_MIN_WIDTH:
        return photometric_loss_reference(
            image, target, l1_weight, ssim_weight, box if drawn is None else None, parts, part_weight
        )
    weights, inside = (l1_weight, ssim_weight), _clipped(box, image)
    boxes = [_clipped(part, image) for part in parts if part_weight > 0]

    def compute(differentiable: bool) -> tuple[Tensor, Tensor | None]:
        gradient, loss = recycled(*image.shape) if differentiable else None, recycled()
        shown = None if drawn is None else drawn.contiguous()
        pictures = unpacked(image.contiguous(), target.contiguous(), shown, gradient, loss)
        _native.photometric_loss(inside, weights, *pictures)
        for part in boxes:
            loss += _add_part(part, image, target, weights, part_weight, gradient)
        return loss, gradient

    return _one_pass(image, compute)


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


class _OnePass(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, compute: Callable[[bool], tuple[Tensor, Tensor | None]]) -> Tensor:
        loss, ctx.gradient = compute(ctx.needs_input_grad[0])
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None]:
        return times(ctx.gradient, grad_loss), None


def _one_pass(values: Tensor, compute: Callable[[bool], tuple[Tensor, Tensor | None]]) -> Float[Tensor, ""]:
    """A loss that is differentiable in `values`, and whose gradient is computed together with it.

    `compute` returns both, the gradient if it is asked for one. Later derivatives only scale it.
    """
    return _OnePass.apply(values, compute)  # pyright: ignore[reportReturnType]


def _add_part(
    part: Box, image: Float[Tensor, "h w 3"], target: Tensor, weights: tuple[float, float], part_weight: float,
    gradient: Float[Tensor, "h w 3"] | None,
) -> Float[Tensor, ""]:  # fmt: skip
    """The weighted loss of the pictures cut to a box. Its gradient is added to that of the whole picture."""
    _, _, width, height = part
    loss = torch.zeros(())
    if width < _NATIVE_MIN_WIDTH or height < 1:
        return loss
    rows, columns = _slices(part)
    cut = image[rows, columns].contiguous()
    own = None if gradient is None else recycled_like(cut)
    share = part_weight * cut.numel() / image.numel()
    pictures = unpacked(cut, target[rows, columns].contiguous(), None, own, loss)
    _native.photometric_loss((0, 0, width, height), (weights[0] * share, weights[1] * share), *pictures)
    if gradient is not None and own is not None:
        gradient[rows, columns] += own
    return loss


def _slices(box: Box) -> tuple[slice, slice]:
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


_LEAST_SIDE = 16
"""Smallest side of what trained features are taken of, in pixels: that of the smallest picture."""


def picture_losses(rendering: Rendering, target: Target, weights: Photometric) -> dict[str, Float[Tensor, ""]]:
    """The weighted losses of one picture, by name. Differentiable in the rendering."""
    # Outside the target's box and the drawn pixels, both pictures show only the background.
    photometric = photometric_loss(
        rendering.image, target.picture, weights.l1_weight, weights.ssim_weight, target.box,
        rendering.alpha, target.parts, weights.part_weight,
    )  # fmt: skip
    losses = {"photometric": photometric}
    if weights.alpha_weight > 0:
        losses["alpha"] = alpha_loss(rendering.alpha, target.matte, weights.alpha_weight)
    return losses


def alpha_loss_reference(alpha: Float[Tensor, "h w"], matte: UInt8[Tensor, "h w"], weight: float) -> Float[Tensor, ""]:
    """`alpha_loss` in plain PyTorch, for any dtype and device."""
    return weight * (alpha - matte.to(alpha) / 255).abs().mean()


@native(alpha_loss_reference, gpu="mien.training.losses_gpu")
def alpha_loss(alpha: Float[Tensor, "h w"], matte: UInt8[Tensor, "h w"], weight: float) -> Float[Tensor, ""]:
    """`weight` times the mean absolute difference between alpha and a matte (0..255). Native for float32 on a CPU."""

    def compute(_: bool) -> tuple[Tensor, Tensor]:
        gradient, loss = recycled_like(alpha), recycled()
        values, target, *filled = unpacked(alpha.contiguous(), matte.contiguous(), gradient, loss)
        _native.absolute_difference(values, target, weight, *filled)
        return loss, gradient

    return _one_pass(alpha, compute)


def color_loss_reference(
    image: Float[Tensor, "h w 3"],
    picture: UInt8[Tensor, "h w 3"],
    weight: float,
    free: float = 0.0,
    counted: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, ""]:
    """`color_loss` in plain PyTorch, for any dtype and device."""
    costs = ((image - picture.to(image) / 255).abs() - free).clamp_min(0)
    return weight * (costs if counted is None else costs * counted.to(image)[..., None]).mean()


@native(color_loss_reference)
def color_loss(
    image: Float[Tensor, "h w 3"],
    picture: UInt8[Tensor, "h w 3"],
    weight: float,
    free: float = 0.0,
    counted: Bool[Tensor, "h w"] | None = None,
) -> Float[Tensor, ""]:
    """`weight` times the mean absolute difference of colours (0..1) from a picture (0..255), less what is free.

    Pixels that are not `counted` add 0 to the mean. Native for float32 on a CPU.
    """

    def compute(_: bool) -> tuple[Tensor, Tensor]:
        gradient, loss = recycled_like(image), recycled()
        known = None if counted is None else counted.contiguous().view(torch.uint8)
        own, target, chosen, *filled = unpacked(image.contiguous(), picture.contiguous(), known, gradient, loss)
        _native.color_difference(own, target, chosen, weight, free, *filled)
        return loss, gradient

    return _one_pass(image, compute)


@dataclass(frozen=True, eq=False)
class PerceptualGoal:
    """What the perceptual loss of one step compares the rendering with."""

    crop: tuple[slice, slice]
    """Rows and columns of the picture."""
    features: Sequence[Float[Tensor, "1 _ _ _"]]
    """Trained features of the target in the crop."""


@torch.no_grad()
def perceptual_goal(target: Target, settings: PerceptualLoss, random: torch.Generator) -> PerceptualGoal:
    """The features of the target's box, or of a crop drawn at random. They do not depend on the avatar."""
    draw = drawn_piece if settings.region == "picture" else drawn_crop
    crop = _slices(person_box(target) if settings.region == "person" else draw(target, settings.crop, random))
    picture = target.picture[crop].to(target.background) / 255
    return PerceptualGoal(crop, _features(picture, settings).features(picture))


def perceptual_loss(rendering: Rendering, goal: PerceptualGoal, settings: PerceptualLoss) -> Float[Tensor, ""]:
    """The weighted distance of trained features on the goal's crop. Differentiable in the rendering."""
    image = rendering.image[goal.crop]
    share = image.numel() / rendering.image.numel() if settings.region == "parts" else 1.0
    return settings.weight * share * _features(image, settings).distance(image, goal.features)


def _features(image: Tensor, settings: PerceptualLoss) -> TrainingFeatures:
    return load_training_features(str(image.device), image.dtype, settings.blocks)


def person_box(target: Target) -> Box:
    """The box of what is not background. It has at least 16 pixels a side, as far as the picture does."""
    full_height, full_width = target.picture.shape[:2]
    left, top, width, height = target.box
    width, height = min(max(width, _LEAST_SIDE), full_width), min(max(height, _LEAST_SIDE), full_height)
    return min(left, full_width - width), min(top, full_height - height), width, height


def drawn_crop(target: Target, side: int, random: torch.Generator) -> Box:
    """A square of `side` pixels inside the picture, or less if the picture is smaller.

    Each part of the target, and the box of what is not background, is chosen equally often. The square's centre is
    anywhere in the chosen box; a square that reaches beyond the picture's border is moved inside.
    """
    full_height, full_width = target.picture.shape[:2]
    boxes = [*target.parts, target.box]
    choice, across, down = torch.rand(3, generator=random, dtype=torch.float64).tolist()
    left, top, width, height = boxes[int(choice * len(boxes))]
    side_x, side_y = min(side, full_width), min(side, full_height)
    x, y = int(left + across * width - side / 2), int(top + down * height - side / 2)
    return min(max(x, 0), full_width - side_x), min(max(y, 0), full_height - side_y), side_x, side_y


def drawn_piece(target: Target, side: int, random: torch.Generator) -> Box:
    """The piece around a random pixel of the picture, which is cut at random places.

    A piece is drawn as often as its share of the pixels says: on average, means over pieces are that of the picture.
    """
    (height, width, _), at = target.picture.shape, torch.rand(4, generator=random, dtype=torch.float64).tolist()
    left, right = piece_of(width, side, int(at[0] * side), int(at[1] * width))
    top, bottom = piece_of(height, side, int(at[2] * side), int(at[3] * height))
    return left, top, right - left, bottom - top


def piece_of(length: int, side: int, first: int, at: int) -> tuple[int, int]:
    """Begin and end of the piece with the pixel `at`, in a row that is cut at `first` and then every `side` pixels.

    Cuts less than 16 pixels from an end do not count. A row of at most `side` pixels is whole.
    """
    cuts = [cut for cut in range(first, length, side) if _LEAST_SIDE <= cut <= length - _LEAST_SIDE and side < length]
    return max((cut for cut in cuts if cut <= at), default=0), min((cut for cut in cuts if cut > at), default=length)


def train_psnr(rendering: Rendering, target: Target) -> float:
    """Peak signal-to-noise ratio of a training picture in dB, over the whole picture."""
    image, picture = rendering.image.detach(), target.picture
    if is_native(image):
        error = _native.mean_squared_difference(image.contiguous(), picture.contiguous())
    else:
        error = float((image - picture.to(image) / 255).square().mean())
    return -10 * math.log10(max(error, 1e-10))
