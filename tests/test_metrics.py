"""Metrics agree with values computed by hand, a slow second implementation of SSIM, and a published ST-LPIPS figure."""

import cv2
import numpy as np
import pytest
import torch

from mien.errors import UserError
from mien.evaluation.metrics import MAX_PSNR, Windows, crop_to, l1, psnr, ssim, ssim_map
from mien.perceptual import distance, load_perceptual, weights


@pytest.fixture
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(24, 31, 3, generator=generator)
    return (target + 0.1 * torch.randn(24, 31, 3, generator=generator)).clamp(0, 1), target


def test_psnr_and_l1_of_a_constant_difference() -> None:
    """A constant difference has the PSNR and L1 of the formulas."""
    target = torch.full((8, 9, 3), 0.25)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert l1(target - 0.1, target) == pytest.approx(0.1, abs=1e-6)


def test_identical_images_have_finite_figures(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    image = pair[1]
    assert psnr(image, image) == MAX_PSNR
    assert l1(image, image) == 0
    assert ssim(image, image) == pytest.approx(1, abs=1e-6)


def test_box_leaves_the_rest_out() -> None:
    target = torch.zeros(10, 12, 3)
    image = target.clone()
    image[2:5, 3:7] = 0.5
    assert psnr(image, target, (3, 2, 4, 3)) == pytest.approx(-10 * np.log10(0.25), abs=1e-4)
    assert psnr(image, target) == pytest.approx(-10 * np.log10(0.25 * 12 / 120), abs=1e-4)


def test_box_is_cut_at_the_border() -> None:
    image = torch.arange(20.0).reshape(4, 5)
    assert crop_to(image, (-2, -1, 4, 3)).tolist() == [[0, 1], [5, 6]]
    assert crop_to(image, (3, 2, 9, 9)).shape == (2, 2)


def test_ssim_equals_a_direct_evaluation_of_its_definition(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    image, target = (t.double().numpy() for t in pair)
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    got = ssim_map(*pair)
    padded = [np.pad(t, ((5, 5), (5, 5), (0, 0))) for t in (image, target)]
    for row, column, channel in ((0, 0, 0), (12, 15, 1), (23, 30, 2), (3, 29, 0)):
        x, y = (p[row : row + 11, column : column + 11, channel] for p in padded)
        mean_x, mean_y = (window * x).sum(), (window * y).sum()
        variance_x, variance_y = (window * x * x).sum() - mean_x**2, (window * y * y).sum() - mean_y**2
        covariance = (window * x * y).sum() - mean_x * mean_y
        expected = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
        expected /= (mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)
        assert float(got[row, column, channel]) == pytest.approx(expected, abs=2e-5)


def _read(path: str) -> torch.Tensor:
    picture = cv2.imread(path)
    assert picture is not None
    return torch.from_numpy(picture[:, :, ::-1].copy()).float() / 255


def test_st_lpips_gives_the_published_figure(test_data) -> None:
    metric = load_perceptual()
    example, reference = (_read(str(test_data / "golden" / f"ex_{name}.png")) for name in ("p0", "ref"))
    assert metric(example, reference) == pytest.approx(0.7777554988861084, abs=1e-5)
    assert metric(reference, reference) == 0
    assert metric(reference, example) == pytest.approx(metric(example, reference), abs=1e-6)


def test_st_lpips_orders_small_shift_below_blur(test_data) -> None:
    metric = load_perceptual()
    picture = _read(str(test_data / "golden" / "ex_ref.png"))
    blurred = torch.from_numpy(cv2.GaussianBlur(picture.numpy(), (0, 0), 3))
    shifted = torch.roll(picture, 1, dims=1)
    assert metric(shifted, picture) < 0.5 * metric(blurred, picture)


@pytest.mark.parametrize("size", [(40, 47), (47, 40), (33, 33), (64, 64)])
def test_first_map_in_one_step_equals_two(size: tuple[int, int]) -> None:
    metric = load_perceptual()
    values = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(1))
    two_steps = distance.halve(metric.convolve(0, values, padding=2))
    torch.testing.assert_close(metric.first_map(values), two_steps, atol=2e-5, rtol=1e-4)


def test_missing_and_damaged_weights_are_the_users_to_mend(monkeypatch, tmp_path) -> None:
    load_perceptual.cache_clear()
    monkeypatch.setattr(weights, "PACKAGE", "no_such_package_here")
    with pytest.raises(UserError, match="pip install stlpips-pytorch"):
        load_perceptual()
    path = tmp_path / "alex.pth"
    monkeypatch.setattr(weights, "weights_path", lambda backbone: path)
    with pytest.raises(UserError, match="missing"):
        load_perceptual()
    torch.save({"scaling_layer.shift": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="damaged"):
        load_perceptual()
    path.write_bytes(b"no weights")
    with pytest.raises(UserError, match="damaged"):
        load_perceptual()
    load_perceptual.cache_clear()


def test_ssim_with_shared_windows_is_that_of_the_target_itself() -> None:
    """To the same bits, also when the windows were used before."""
    first, second, target = torch.rand(3, 40, 33, 3)
    windows = Windows.of(target)
    for image in (first, second, first):
        assert torch.equal(ssim_map(image, windows), ssim_map(image, target))
