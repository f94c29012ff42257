"""The fused L1 + SSIM loss agrees with its plain PyTorch reference."""

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate

from mien import _native
from mien.pictures import Box
from mien.training.photometric import differentiable_ssim_map, photometric_loss, photometric_loss_reference
from rasterize_scenes import relative_error

WHOLE_AND_PARTS = [
    (64, 48, None), (37, 53, (5, 7, 20, 11)), (40, 40, (-3, 8, 10, 20)), (40, 64, (60, 39, 1, 1)), (120, 6, None),
    (3, 300, None), (200, 101, (90, 150, 100, 100)), (5, 3, None),
]  # fmt: skip
"""The last but one reaches beyond the picture, and the last is too narrow for the native path."""


def smooth_picture(height: int, width: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 8 + 2, width // 8 + 2, generator=generator)
    return interpolate(coarse, (height, width), mode="bilinear")[0].permute(1, 2, 0).contiguous()


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return a noisy picture and another one. Both have a white part, in which SSIM's variances vanish."""
    noise = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(2))
    image, target = smooth_picture(height, width, 0) + 0.05 * noise, smooth_picture(height, width, 1)
    image[: height // 3], target[: height // 3] = 1, 1
    return image, target


def exact(image: Tensor, target: Tensor, weights: tuple[float, float], box: Box | None) -> tuple[Tensor, Tensor]:
    """Return value and gradient in float64."""
    image = image.double().requires_grad_()
    loss = photometric_loss_reference(image, target.double(), *weights, box)
    return loss.detach(), torch.autograd.grad(loss, image)[0]


@pytest.mark.parametrize(("height", "width", "box"), WHOLE_AND_PARTS)
@pytest.mark.parametrize("weights", [(0.8, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_value_and_gradient_equal_the_float64_reference(isa, height, width, box, weights: tuple[float, float]):
    image, target = pair(height, width)
    value, gradient = exact(image, target, weights, box)
    image.requires_grad_()
    loss = photometric_loss(image, target, *weights, box)
    (3 * loss).backward()
    assert image.grad is not None
    torch.testing.assert_close(loss.detach().double(), value, atol=1e-6, rtol=1e-6)
    # In the white part float32 errs by about 1e-4 of the variances' floor C2. PyTorch's own float32 is no better.
    assert relative_error(image.grad, 3 * gradient) < 5e-5
    try:
        for threads in (1, 2, 3):
            _native.set_thread_count(threads)
            again = photometric_loss(image, target, *weights, box)
            assert again == loss
            assert torch.equal(torch.autograd.grad(3 * again, image)[0], image.grad)
    finally:
        _native.set_thread_count(0)
    with torch.no_grad():
        assert photometric_loss(image, target, *weights, box) == loss


def test_a_box_around_all_differences_changes_nothing():
    _, target = pair(60, 80)
    image = target.clone()
    image[25:35, 30:50] += 0.1 * torch.randn(10, 20, 3, generator=torch.Generator().manual_seed(3))
    image.requires_grad_()
    box = (25, 20, 30, 20)  # 5 pixels of margin
    whole, part = photometric_loss(image, target), photometric_loss(image, target, box=box)
    torch.testing.assert_close(whole, part, atol=1e-7, rtol=1e-6)
    differences = torch.autograd.grad(whole, image)[0] - torch.autograd.grad(part, image)[0]
    assert differences.abs().max() < 1e-7
    # Equal pictures lose nothing, and neither does a box outside of the picture.
    assert differentiable_ssim_map(target, target).mean() == 1
    assert abs(float(photometric_loss(target, target))) < 1e-6
    assert photometric_loss(target, target, box=(80, 60, 10, 10)) == 0


def test_ssim_follows_its_formula():
    image, target = (picture.double() for picture in pair(30, 30))
    distances = torch.arange(11).double() - 5
    window = (-(distances[:, None] ** 2 + distances**2) / 4.5).exp()
    window /= window.sum()
    x, y = image[12:23, 9:20, 1], target[12:23, 9:20, 1]
    mean_x, mean_y = (window * x).sum(), (window * y).sum()
    variance_x, variance_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
    covariance = (window * (x - mean_x) * (y - mean_y)).sum()
    expected = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
    expected /= (mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)
    torch.testing.assert_close(differentiable_ssim_map(image, target)[17, 14, 1], expected)
    # Zeros beyond the border.
    mean_at_corner = conv2d(image[None, None, :, :, 0], window[None, None], padding=5)[0, 0, 0, 0]
    black = torch.zeros_like(image)
    assert differentiable_ssim_map(image, black)[0, 0, 0] < 1e-4 / (mean_at_corner**2 + 1e-4)


@pytest.mark.parametrize("bytes_given", [False, True])
def test_parts_count_again_as_pictures_of_their_own(isa: str, bytes_given: bool) -> None:
    image, target = pair(37, 53)
    target = (target.clamp(0, 1) * 255).to(torch.uint8) if bytes_given else target
    parts = [(5, 7, 20, 11), (40, 20, 30, 30), (2, 2, 4, 9)]  # the second reaches beyond the picture
    wanted = image.double().requires_grad_()
    goal = target.double() / (255 if bytes_given else 1)
    loss = photometric_loss_reference(wanted, goal, parts=parts, part_weight=1.5)
    by_hand = photometric_loss_reference(wanted, goal)
    for left, top, width, height in parts:
        rows, columns = slice(top, top + height), slice(left, left + width)
        cut = photometric_loss_reference(wanted[rows, columns], goal[rows, columns])
        by_hand = by_hand + 1.5 * cut * wanted[rows, columns].numel() / wanted.numel()
    assert float(loss.detach()) == pytest.approx(float(by_hand.detach()), rel=1e-12)

    parts = parts[:2]  # the third is too narrow for the native path
    loss = photometric_loss_reference(wanted, goal, parts=parts, part_weight=1.5)
    found = image.clone().requires_grad_()
    native = photometric_loss(found, target, parts=parts, part_weight=1.5)
    assert float(native.detach()) == pytest.approx(float(loss.detach()), rel=1e-5)
    gradient = torch.autograd.grad(native, found)[0]
    assert relative_error(gradient, torch.autograd.grad(loss, wanted)[0]) < 1e-4
