"""The perceptual loss: features, crops and steps. The fused L1 + SSIM loss agrees with its plain PyTorch reference."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, max_pool2d

import train_toy
from mien import _native
from mien.avatar.settings import PerceptualLoss, Photometric
from mien.camera import Box
from mien.errors import UserError
from mien.face import FaceModel
from mien.gaussians import Rendering
from mien.perceptual import weights_path
from mien.perceptual.features import load_training_features
from mien.training import PRESETS, train
from mien.training import losses as photometry
from mien.training.footage.frames import CROP, random_at
from mien.training.footage.sequence import Sequence, Target, Targets
from mien.training.run import read_curves
from rasterize_scenes import relative_error
from toy_scene import toy_sequence
from train_toy import silence


def some_picture(seed: int, side: int = 32) -> torch.Tensor:
    coarse = torch.rand(1, 3, side // 4, side // 4, generator=torch.Generator().manual_seed(seed))
    return interpolate(coarse, (side, side), mode="bilinear")[0].permute(1, 2, 0).contiguous()


def by_torchs_layers(image: torch.Tensor, target: torch.Tensor) -> float:
    """Return the distance by two blocks, with torch's own pooling and the blur kernel from the file."""
    state = torch.load(weights_path("st-lpips-vgg"), map_location="cpu", weights_only=True)

    def maps(picture: torch.Tensor) -> list[torch.Tensor]:
        values = (picture.permute(2, 0, 1)[None] * 2 - 1 - state["scaling_layer.shift"]) / state["scaling_layer.scale"]
        found = []
        for slice_, layers in ((1, (0, 2)), (2, (6, 8))):
            if slice_ == 2:
                values = conv2d(max_pool2d(values, 2, 1), state["net.slice2.5.filt"], stride=2, groups=64)
            for layer in layers:
                name = f"net.slice{slice_}.{layer}"
                values = conv2d(values, state[f"{name}.weight"], state[f"{name}.bias"], padding=1).relu()
            found.append(values / values.norm(dim=1, keepdim=True).clamp_min(1e-5))
        return found

    pairs = zip(maps(image), maps(target), strict=True)
    factors = (state[f"lin{index}.model.1.weight"] for index in range(2))
    return sum(float(conv2d((a - b).square(), factor).mean()) for (a, b), factor in zip(pairs, factors, strict=True))


def test_the_distance_is_that_of_the_networks_layers_in_crops_of_every_part() -> None:
    features = load_training_features(blocks=2)
    image, target = some_picture(0), some_picture(1)
    assert float(features(target, target)) == 0
    assert float(features(image, target)) == pytest.approx(by_torchs_layers(image, target), rel=1e-3)
    target = some_target(((20, 10, 30, 10), (70, 50, 8, 8)))
    crops, again = (
        [photometry.drawn_crop(target, 24, random_at(0, CROP, step)) for step in range(200)] for _ in range(2)
    )
    assert crops == again
    assert all(x >= 0 and y >= 0 and x + 24 <= 80 and y + 24 <= 60 for x, y, _, _ in crops)
    assert {crop[2:] for crop in crops} == {(24, 24)}
    near_mouth = sum(crop[:2] == (56, 36) for crop in crops)
    assert 30 < near_mouth < 110, "a third of the crops is drawn around the part at the corner"
    assert len(set(crops)) > 80, "the others differ"
    assert photometry.drawn_crop(target, 512, random_at(0, CROP, 0)) == (0, 0, 80, 60)


def some_target(parts: tuple[tuple[int, int, int, int], ...], height: int = 60, width: int = 80) -> Target:
    picture = torch.zeros(height, width, 3, dtype=torch.uint8)
    return Target(picture, picture[..., 0], (10, 5, 50, 50), torch.ones(3), parts)


def loss_of(width: int, settings: PerceptualLoss) -> tuple[float, torch.Size]:
    """The loss of a gray picture of height 64 in place of a darker one, and the size of what is compared."""
    image, radii = torch.full((64, width, 3), 0.5), torch.zeros(1, dtype=torch.int32)
    rendering = Rendering(image, torch.ones(64, width), radii, torch.zeros(1, 2))
    target = replace(some_target((), 64, width), picture=torch.full((64, width, 3), 90, dtype=torch.uint8))
    goal = photometry.perceptual_goal(target, settings, random_at(0, CROP, 0))
    return float(photometry.perceptual_loss(rendering, goal, settings)), target.picture[goal.crop].shape


def whole(side: int) -> float:
    """The distance of a square of both grays."""
    return float(load_training_features()(torch.full((side, side, 3), 0.5), torch.full((side, side, 3), 90 / 255)))


def test_weight_of_a_pixel_is_that_of_the_whole_picture() -> None:
    """The same crop counts half as much in a picture that is twice as large."""
    losses = [loss_of(width, PerceptualLoss(weight=2.0, crop=32))[0] for width in (64, 128)]
    assert losses == pytest.approx([0.5 * whole(32), 0.25 * whole(32)], rel=1e-5)
    # A picture of 128 x 64 has no square of 100 pixels, so the crop is 100 wide and 64 high.
    assert loss_of(128, PerceptualLoss(crop=100))[1] == (64, 100, 3)


def test_the_whole_person_counts_fully() -> None:
    """The box of the person is compared, which is never too small. Its share of the picture does not matter."""
    found = [loss_of(width, PerceptualLoss(weight=2.0, region="person", crop=16)) for width in (64, 128)]
    assert found == [(pytest.approx(2.0 * whole(50), rel=1e-5), (50, 50, 3))] * 2
    boxes = {(10, 5, 50, 40): (10, 5, 50, 40), (0, 0, 0, 0): (0, 0, 16, 16), (78, 59, 2, 1): (64, 44, 16, 16)}
    assert {box: photometry.person_box(replace(some_target(()), box=box)) for box in boxes} == boxes


@pytest.mark.parametrize(("length", "side"), [(100, 32), (75, 48), (90, 89), (40, 60)])
def test_pieces_of_a_picture_have_its_mean_on_average(length: int, side: int) -> None:
    """Each pixel has the same weight, over all places of the cuts and of the pixel that is drawn."""
    weights, sizes = np.zeros(length), set()
    for first, at in np.ndindex(side, length):
        begin, end = photometry.piece_of(length, side, first, at)
        assert begin <= at < end
        sizes.add(end - begin)
        weights[begin:end] += 1 / (end - begin) / side
    np.testing.assert_allclose(weights, 1)
    assert (min(sizes) >= 16, max(sizes) < side + 32, len(sizes) > 1) == (True, True, length > side)


def test_a_piece_of_the_picture_counts_fully() -> None:
    """At every resolution. It may be anywhere, also in the background."""
    for paper in (PRESETS["paper"].config(name) for name in ("mono_gaussian_avatar", "point_avatar")):
        assert (paper.photometric.perceptual.weight, paper.photometric.perceptual.region) == (0.1, "picture")
    settings = PerceptualLoss(weight=2.0, region="picture", crop=32)
    for width in (64, 128):
        loss, (height, wide, _) = loss_of(width, settings)
        image, dark = torch.full((height, wide, 3), 0.5), torch.full((height, wide, 3), 90 / 255)
        assert loss == pytest.approx(2 * float(load_training_features()(image, dark)), rel=1e-5)
    boxes = np.array([photometry.drawn_piece(some_target(()), 24, random_at(0, CROP, step)) for step in range(50)])
    assert (boxes[:, :2].min(), (boxes[:, :2] + boxes[:, 2:]).max(0).tolist()) == (0, [80, 60])


CONFIG = replace(
    train_toy.CONFIG, photometric=Photometric(part_weight=1.0, perceptual=PerceptualLoss(0.5, 0.1, 2, 16, 1))
)


@pytest.fixture(scope="module")
def scene() -> tuple[FaceModel, Sequence]:
    """The toy head has lips: its triangles in front and below."""
    face_model, sequence = toy_sequence(timesteps=5, size=32)
    middle = face_model.template[face_model.faces].mean(1)
    lips = (middle[:, 2] > 0.05) & (middle[:, 1] < 0)
    return replace(face_model, region_names=("skin", "lips"), face_regions=lips.long()), sequence


def test_targets_have_parts_if_they_are_asked_for(scene: tuple[FaceModel, Sequence]) -> None:
    sequence, white = toy_sequence(timesteps=2, size=64)[1], np.full(3, 255, np.uint8)
    none, (mouth,), (half,) = (
        Targets(sequence, size, face_model=model).target(0, 0, white, keep=False).parts
        for size, model in ((0, None), (0, scene[0]), (32, scene[0]))
    )
    assert none == ()
    assert all(abs(2 * small - large) <= 1 for small, large in zip(half, mouth, strict=True))


@pytest.mark.unchecked
def test_the_loss_is_recorded_at_its_steps(scene: tuple[FaceModel, Sequence], tmp_path: Path) -> None:
    for name, config in (("whole", CONFIG), ("plain", train_toy.CONFIG)):
        train([scene[1]], scene[0], config, replace(train_toy.SETTINGS, steps=12), tmp_path / name, silence)
    curves = read_curves(tmp_path / "whole")
    assert [value > 0 for value in curves["perceptual"].tolist()] == [True, False] * 2, "0 at steps without it"
    assert "perceptual" not in read_curves(tmp_path / "plain")
    for name in ("avatar/avatar.safetensors", "face_track.safetensors"):
        assert (tmp_path / "plain" / name).read_bytes() != (tmp_path / "whole" / name).read_bytes(), name


def test_missing_features_are_told_before_the_run_begins(scene, tmp_path, monkeypatch) -> None:
    load_training_features.cache_clear()
    monkeypatch.setitem(sys.modules, "stlpips_pytorch", None)
    with pytest.raises(UserError, match="pip install stlpips-pytorch"):
        train([scene[1]], scene[0], CONFIG, train_toy.SETTINGS, tmp_path / "run", silence)
    assert not (tmp_path / "run").exists()


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
    loss = photometry.photometric_loss_reference(image, target.double(), *weights, box)
    return loss.detach(), torch.autograd.grad(loss, image)[0]


@pytest.mark.parametrize(("height", "width", "box"), WHOLE_AND_PARTS)
@pytest.mark.parametrize("weights", [(0.8, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_value_and_gradient_equal_the_float64_reference(isa, height, width, box, weights: tuple[float, float]):
    image, target = pair(height, width)
    value, gradient = exact(image, target, weights, box)
    image.requires_grad_()
    loss = photometry.photometric_loss(image, target, *weights, box)
    (3 * loss).backward()
    assert image.grad is not None
    torch.testing.assert_close(loss.detach().double(), value, atol=1e-6, rtol=1e-6)
    # In the white part float32 errs by about 1e-4 of the variances' floor C2. PyTorch's own float32 is no better.
    assert relative_error(image.grad, 3 * gradient) < 5e-5
    try:
        for threads in (1, 2, 3):
            _native.set_thread_count(threads)
            again = photometry.photometric_loss(image, target, *weights, box)
            assert again == loss
            assert torch.equal(torch.autograd.grad(3 * again, image)[0], image.grad)
    finally:
        _native.set_thread_count(0)
    with torch.no_grad():
        assert photometry.photometric_loss(image, target, *weights, box) == loss


def test_a_box_around_all_differences_changes_nothing():
    _, target = pair(60, 80)
    image = target.clone()
    image[25:35, 30:50] += 0.1 * torch.randn(10, 20, 3, generator=torch.Generator().manual_seed(3))
    image.requires_grad_()
    box = (25, 20, 30, 20)  # 5 pixels of margin
    whole, part = photometry.photometric_loss(image, target), photometry.photometric_loss(image, target, box=box)
    torch.testing.assert_close(whole, part, atol=1e-7, rtol=1e-6)
    assert (torch.autograd.grad(whole, image)[0] - torch.autograd.grad(part, image)[0]).abs().max() < 1e-7
    # Equal pictures lose nothing, and neither does a box outside of the picture.
    assert photometry.differentiable_ssim_map(target, target).mean() == 1
    assert abs(float(photometry.photometric_loss(target, target))) < 1e-6
    assert photometry.photometric_loss(target, target, box=(80, 60, 10, 10)) == 0


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
    torch.testing.assert_close(photometry.differentiable_ssim_map(image, target)[17, 14, 1], expected)
    # Zeros beyond the border.
    mean_at_corner = conv2d(image[None, None, :, :, 0], window[None, None], padding=5)[0, 0, 0, 0]
    black = torch.zeros_like(image)
    assert photometry.differentiable_ssim_map(image, black)[0, 0, 0] < 1e-4 / (mean_at_corner**2 + 1e-4)


@pytest.mark.parametrize("bytes_given", [False, True])
def test_parts_count_again_as_pictures_of_their_own(isa: str, bytes_given: bool) -> None:
    image, target = pair(37, 53)
    target = (target.clamp(0, 1) * 255).to(torch.uint8) if bytes_given else target
    parts = [(5, 7, 20, 11), (40, 20, 30, 30), (2, 2, 4, 9)]  # the second reaches beyond the picture
    wanted = image.double().requires_grad_()
    goal = target.double() / (255 if bytes_given else 1)
    loss = photometry.photometric_loss_reference(wanted, goal, parts=parts, part_weight=1.5)
    by_hand = photometry.photometric_loss_reference(wanted, goal)
    for left, top, width, height in parts:
        rows, columns = slice(top, top + height), slice(left, left + width)
        cut = photometry.photometric_loss_reference(wanted[rows, columns], goal[rows, columns])
        by_hand = by_hand + 1.5 * cut * wanted[rows, columns].numel() / wanted.numel()
    assert float(loss.detach()) == pytest.approx(float(by_hand.detach()), rel=1e-12)
    parts = parts[:2]  # the third is too narrow for the native path
    loss = photometry.photometric_loss_reference(wanted, goal, parts=parts, part_weight=1.5)
    found = image.clone().requires_grad_()
    native = photometry.photometric_loss(found, target, parts=parts, part_weight=1.5)
    assert float(native.detach()) == pytest.approx(float(loss.detach()), rel=1e-5)
    gradient = torch.autograd.grad(native, found)[0]
    assert relative_error(gradient, torch.autograd.grad(loss, wanted)[0]) < 1e-4
