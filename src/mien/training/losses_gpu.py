"""The losses of pictures in kernels for a GPU. A picture and its parts take three launches forward and one backward.

SSIM is a mean of windows. Its derivative by a pixel is a sum over the windows that see the pixel: the first kernel
computes their derivatives by the windows' means, and the second adds them up.
"""

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.camera import Box
from mien.kernels import blocks, launch

_BLOCK = 512
_FALLOFF = tl.constexpr(-1 / (2 * 1.5**2))
_TOTAL = tl.constexpr(sum(math.exp(-(d * d) / (2 * 1.5**2)) for d in range(-5, 6)) ** 2)
"""Sum of the weights of an SSIM window before they are normalised."""
_C1 = tl.constexpr(0.01**2)
_C2 = tl.constexpr(0.03**2)


def photometric_loss(
    image: Tensor, target: Tensor, weights: tuple[float, float], inside: Box, parts: Sequence[Box], part_weight: float
) -> Tensor:
    """`mien.training.losses.photometric_loss` of pixels `inside` a box, and of parts, whose boxes are clipped."""
    return _Photometric.apply(image, target, weights, inside, parts, part_weight)  # pyright: ignore[reportReturnType]


def alpha_loss(alpha: Tensor, matte: Tensor, weight: float) -> Tensor:
    """`mien.training.losses.alpha_loss`."""
    return _Alpha.apply(alpha, matte, weight)  # pyright: ignore[reportReturnType]


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, weights: tuple[float, float], inside: Box, parts: Sequence[Box],
        part_weight: float,
    ) -> Tensor:  # fmt: skip
        image, target = image.contiguous(), target.contiguous()
        height, width = image.shape[:2]
        boxes, program, first = [], 0, 0
        for number, box in enumerate(((0, 0, width, height), *parts)):
            share = (part_weight if number else 1.0) / max(image.numel(), 1)
            # Numbers with a fraction are not looked at by the compiler, so a kernel serves all boxes.
            boxes += map(float, (*box, program, first, share))
            program, first = program + blocks(3 * box[2] * box[3], _BLOCK), first + 3 * box[2] * box[3]
        sums, slopes = image.new_empty(program), image.new_empty(3, first)
        limits = (inside[0], inside[1], inside[0] + inside[2], inside[1] + inside[3])
        common = (image, target, slopes, width, first, tuple(boxes), *map(float, limits), *weights)
        launch(_windows, program, sums, *common, BYTES=target.dtype == torch.uint8, BLOCK=_BLOCK)
        if ctx.needs_input_grad[0]:
            gradient = torch.empty_like(image)
            elements = image.numel()
            launch(
                _add_windows, blocks(elements, _BLOCK), gradient, elements, *common,
                BYTES=target.dtype == torch.uint8, BLOCK=_BLOCK,
            )  # fmt: skip
            ctx.save_for_backward(gradient)
        return sums.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * of_loss, *[None] * 5


class _Alpha(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, alpha: Tensor, matte: Tensor, weight: float) -> Tensor:
        alpha, elements = alpha.contiguous(), alpha.numel()
        programs = blocks(elements, _BLOCK)
        gradient, sums = torch.empty_like(alpha), alpha.new_empty(programs)
        share = weight / max(elements, 1)
        launch(_differences, programs, alpha, matte.contiguous(), gradient, sums, elements, share, BLOCK=_BLOCK)
        ctx.save_for_backward(gradient)
        return sums.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_loss: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * of_loss, None, None


@no_type_check
@triton.jit
def _differences(alpha, matte, gradient, sums, elements, share, BLOCK: tl.constexpr):
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = at < elements
    own = tl.load(alpha + at, mask=there, other=0.0)
    difference = own - tl.load(matte + at, mask=there, other=0).to(own.dtype) / 255
    tl.store(gradient + at, share * _sign(difference), mask=there)
    tl.store(sums + tl.program_id(0), share * tl.sum(tl.where(there, tl.abs(difference), 0.0), 0))


@no_type_check
@triton.jit
def _sign(values):
    # NaN is neither above nor below 0, and stays.
    return tl.where(values > 0, 1.0, tl.where(values < 0, -1.0, values))


@no_type_check
@triton.jit
def _color(picture, at, there, image, BYTES: tl.constexpr):
    """Numbers of the target, 0..1, in the image's dtype."""
    value = tl.load(picture + at, mask=there, other=0).to(image.dtype.element_ty)
    return value / 255 if BYTES else value


@no_type_check
@triton.jit
def _windows(
    sums, image, target, slopes, width, total, boxes, from_x, from_y, to_x, to_y, l1, ssim, BYTES: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The loss of a block of a box, and derivatives of SSIM by the window's mean, mean square and mean product."""
    program = tl.program_id(0)
    dtype = image.dtype.element_ty
    left, top, across, down, before, first, share = 0, 0, 0, 0, 0, 0, tl.cast(boxes[6], tl.float32)
    for i in tl.static_range(len(boxes) // 7):
        here = program >= tl.cast(boxes[7 * i + 4], tl.int32)
        left = tl.where(here, tl.cast(boxes[7 * i], tl.int32), left)
        top = tl.where(here, tl.cast(boxes[7 * i + 1], tl.int32), top)
        across = tl.where(here, tl.cast(boxes[7 * i + 2], tl.int32), across)
        down = tl.where(here, tl.cast(boxes[7 * i + 3], tl.int32), down)
        before = tl.where(here, tl.cast(boxes[7 * i + 4], tl.int32), before)
        first = tl.where(here, tl.cast(boxes[7 * i + 5], tl.int32), first)
        share = tl.where(here, boxes[7 * i + 6], share)
    at = (program - before) * BLOCK + tl.arange(0, BLOCK)
    there, pixel, channel = at < 3 * across * down, at // 3, at % 3
    y, x = pixel // tl.maximum(across, 1), pixel % tl.maximum(across, 1)
    zero = tl.zeros([BLOCK], dtype)
    mean_x, mean_y, square_x, square_y, product = zero, zero, zero, zero, zero
    for tap in range(121):
        dy, dx = tap // 11 - 5, tap % 11 - 5
        weight = tl.exp(tl.cast(dy * dy + dx * dx, dtype) * _FALLOFF) / _TOTAL
        seen = there & (y + dy >= 0) & (y + dy < down) & (x + dx >= 0) & (x + dx < across)
        near = 3 * ((top + y + dy) * width + left + x + dx) + channel
        own, other = tl.load(image + near, mask=seen, other=0.0), _color(target, near, seen, image, BYTES)
        mean_x, mean_y = mean_x + weight * own, mean_y + weight * other
        square_x, square_y = square_x + weight * own * own, square_y + weight * other * other
        product += weight * own * other
    above1, above2 = 2 * mean_x * mean_y + _C1, 2 * (product - mean_x * mean_y) + _C2
    below1 = mean_x * mean_x + mean_y * mean_y + _C1
    below2 = square_x - mean_x * mean_x + square_y - mean_y * mean_y + _C2
    likeness = above1 * above2 / (below1 * below2)
    # A box limits what counts in the whole picture, which comes first.
    counts = there & ((first > 0) | ((x >= from_x) & (x < to_x) & (y >= from_y) & (y < to_y)))
    scale = tl.where(counts, -ssim * share, 0.0)
    by_mean = 2 * mean_y * (above2 - above1) / (below1 * below2) - 2 * mean_x * likeness * (1 / below1 - 1 / below2)
    tl.store(slopes + first + at, scale * by_mean, mask=there)
    tl.store(slopes + total + first + at, scale * -likeness / below2, mask=there)
    tl.store(slopes + 2 * total + first + at, scale * 2 * above1 / (below1 * below2), mask=there)
    middle = 3 * ((top + y) * width + left + x) + channel
    own, other = tl.load(image + middle, mask=there, other=0.0), _color(target, middle, there, image, BYTES)
    loss = share * (l1 * tl.abs(own - other) + ssim * (1 - likeness))
    tl.store(sums + program, tl.sum(tl.where(counts, loss, 0.0), 0))


@no_type_check
@triton.jit
def _add_windows(
    gradient, elements, image, target, slopes, width, total, boxes, from_x, from_y, to_x, to_y, l1, ssim,
    BYTES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The derivative of the loss by each colour of the picture."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    dtype = image.dtype.element_ty
    there, pixel, channel = at < elements, at // 3, at % 3
    own, other = tl.load(image + at, mask=there, other=0.0), _color(target, at, there, image, BYTES)
    result, sign = tl.zeros([BLOCK], dtype), _sign(own - other)
    for i in tl.static_range(len(boxes) // 7):
        across, down = tl.cast(boxes[7 * i + 2], tl.int32), tl.cast(boxes[7 * i + 3], tl.int32)
        x, y = pixel % width - tl.cast(boxes[7 * i], tl.int32), pixel // width - tl.cast(boxes[7 * i + 1], tl.int32)
        inside = there & (x >= 0) & (x < across) & (y >= 0) & (y < down)
        start = slopes + tl.cast(boxes[7 * i + 5], tl.int32) + channel
        for tap in range(121):
            dy, dx = tap // 11 - 5, tap % 11 - 5
            weight = tl.exp(tl.cast(dy * dy + dx * dx, dtype) * _FALLOFF) / _TOTAL
            seen = inside & (y + dy >= 0) & (y + dy < down) & (x + dx >= 0) & (x + dx < across)
            near = start + 3 * ((y + dy) * across + x + dx)
            by_mean = tl.load(near, mask=seen, other=0.0)
            by_square = tl.load(near + total, mask=seen, other=0.0)
            by_product = tl.load(near + 2 * total, mask=seen, other=0.0)
            result += weight * (by_mean + 2 * own * by_square + other * by_product)
        counts = inside
        if i == 0:
            counts = inside & (x >= from_x) & (x < to_x) & (y >= from_y) & (y < to_y)
        result += tl.where(counts, boxes[7 * i + 6] * l1 * sign, 0.0)
    tl.store(gradient + at, result, mask=there)
