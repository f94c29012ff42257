"""Metrics agree with second implementations and published figures, LPIPS as well. Pictures of reports are right."""

import base64
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from mien import perceptual
from mien.cli import main
from mien.disk.files import read_json
from mien.evaluation import scoring
from mien.evaluation.metrics import MAX_PSNR, Windows, crop_to, l1, psnr, ssim, ssim_map
from mien.media.pictures import error_heat, heat_colors, picture_grid, picture_uri, shrink, side_by_side, to_uint8
from mien.media.source import read_image
from mien.perceptual import distance, lpips
from mien.perceptual.distance import load_perceptual
from refusals import complaint, refuses


def test_psnr_and_l1() -> None:
    target = torch.full((8, 9, 3), 0.25)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert l1(target - 0.1, target) == pytest.approx(0.1, abs=1e-6)
    assert (psnr(target, target), l1(target, target)) == (MAX_PSNR, 0)
    # A box leaves the rest out, and is cut at the border.
    target = torch.zeros(10, 12, 3)
    image = target.clone()
    image[2:5, 3:7] = 0.5
    assert psnr(image, target, (3, 2, 4, 3)) == pytest.approx(-10 * np.log10(0.25), abs=1e-4)
    assert psnr(image, target) == pytest.approx(-10 * np.log10(0.25 * 12 / 120), abs=1e-4)
    image = torch.arange(20.0).reshape(4, 5)
    assert crop_to(image, (-2, -1, 4, 3)).tolist() == [[0, 1], [5, 6]]
    assert crop_to(image, (3, 2, 9, 9)).shape == (2, 2)


def test_ssim_equals_a_direct_evaluation_of_its_definition() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(24, 31, 3, generator=generator)
    image = (target + 0.1 * torch.randn(24, 31, 3, generator=generator)).clamp(0, 1)
    assert ssim(image, image) == pytest.approx(1, abs=1e-6)
    window = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2
    got = ssim_map(image, target)
    padded = [np.pad(t.double().numpy(), ((5, 5), (5, 5), (0, 0))) for t in (image, target)]
    for row, column, channel in ((0, 0, 0), (12, 15, 1), (23, 30, 2), (3, 29, 0)):
        x, y = (p[row : row + 11, column : column + 11, channel] for p in padded)
        mean_x, mean_y = (window * x).sum(), (window * y).sum()
        variance_x, variance_y = (window * x * x).sum() - mean_x**2, (window * y * y).sum() - mean_y**2
        covariance = (window * x * y).sum() - mean_x * mean_y
        expected = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
        expected /= (mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)
        assert float(got[row, column, channel]) == pytest.approx(expected, abs=2e-5)
    windows = Windows.of(target)  # to the same bits, also when the windows were used before
    assert torch.equal(ssim_map(image, windows), got)
    assert torch.equal(ssim_map(image, windows), got)


def test_st_lpips_gives_the_published_figure(test_data) -> None:
    metric = load_perceptual()
    example, reference = (
        torch.from_numpy(read_image(test_data / "golden" / f"ex_{name}.png")).float() / 255 for name in ("p0", "ref")
    )
    assert metric(example, reference) == pytest.approx(0.7777554988861084, abs=1e-5)
    assert metric(reference, reference) == 0
    assert metric(reference, example) == pytest.approx(metric(example, reference), abs=1e-6)
    blurred = torch.from_numpy(cv2.GaussianBlur(reference.numpy(), (0, 0), 3))
    assert metric(torch.roll(reference, 1, dims=1), reference) < 0.5 * metric(blurred, reference), "a shift is small"


@pytest.mark.parametrize("size", [(40, 47), (47, 40), (33, 33), (64, 64)])
def test_first_map_in_one_step_equals_two(size: tuple[int, int]) -> None:
    metric = load_perceptual()
    values = torch.randn(1, 3, *size, generator=torch.Generator().manual_seed(1))
    two_steps = distance.halve(metric.convolve(0, values, padding=2))
    torch.testing.assert_close(metric.first_map(values), two_steps, atol=2e-5, rtol=1e-4)


def test_missing_and_damaged_weights_are_the_users_to_mend(monkeypatch, tmp_path) -> None:
    load_perceptual.cache_clear()
    monkeypatch.setattr(perceptual, "PACKAGE", "no_such_package_here")
    refuses("pip install stlpips-pytorch", load_perceptual)
    path = tmp_path / "alex.pth"
    monkeypatch.setattr(perceptual, "weights_path", lambda backbone: path)
    for content, words in (
        (None, "missing"), (b"no weights", "damaged"), ({"scaling_layer.shift": torch.zeros(1)}, "damaged"),
    ):  # fmt: skip
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content is not None:
            torch.save(content, path)
        refuses(words, load_perceptual)
    load_perceptual.cache_clear()


CHANNELS = {"lpips-alex": (64, 192, 384, 256, 256), "lpips-vgg": (64, 128, 256, 512, 512)}
COMPARED = {"lpips-alex": (1, 4, 7, 9, 11), "lpips-vgg": (3, 8, 15, 22, 29)}
"""Layers of torchvision's networks whose maps LPIPS compares. Of VGG16: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3."""
TRUNKS = {trunk.backbone: trunk for trunk in lpips.TRUNKS}


LAYERS = {
    "lpips-alex": ((64, 11, 4, 2), None, (192, 5, 1, 2), None, (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
    "lpips-vgg": tuple(
        layer for width, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
        for layer in (*depth * [(width, 3, 1, 1)], None)
    ),
}  # fmt: skip
"""Width, kernel, stride and padding of each convolution of AlexNet and VGG16 in torchvision's order; None: pooling."""


def _trunk(backbone: str) -> nn.Sequential:
    torch.manual_seed(3)
    layers, channels = [], 3
    for layer in LAYERS[backbone]:
        if layer is None:
            layers.append(nn.MaxPool2d(3 if backbone == "lpips-alex" else 2, 2))
        else:
            layers += [nn.Conv2d(channels, *layer), nn.ReLU()]
            channels = layer[0]
    return nn.Sequential(*layers)


def _write(folder: Path, backbone: str) -> tuple[Path, Path]:
    weights = {f"features.{name}": value for name, value in _trunk(backbone).state_dict().items()}
    torch.save(weights, folder / "trunk.pth")
    torch.manual_seed(4)
    heads = {f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(CHANNELS[backbone])}
    torch.save(heads, folder / "heads.pth")
    return folder / "trunk.pth", folder / "heads.pth"


def _by_formula(backbone: str, first: Tensor, second: Tensor, heads: dict[str, Tensor]) -> float:
    """Return LPIPS as the paper and its package define it."""
    trunk, total = _trunk(backbone), 0.0
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    values = [((2 * image - 1 - shift) / scale).permute(2, 0, 1)[None] for image in (first, second)]
    tap = 0
    with torch.no_grad():
        for index, layer in enumerate(trunk):
            values = [layer(value) for value in values]
            if index in COMPARED[backbone]:
                unit = [value / (value.square().sum(1, keepdim=True).sqrt() + 1e-10) for value in values]
                weighted = (unit[0] - unit[1]).square() * heads[f"lin{tap}.model.1.weight"]
                total += float(weighted.sum(1).mean())
                tap += 1
    assert tap == 5
    return total


@pytest.mark.parametrize("backbone", TRUNKS)
def test_it_is_the_published_formula(backbone: str, tmp_path: Path) -> None:
    trunk, heads = _write(tmp_path, backbone)
    metric = lpips.build_lpips(TRUNKS[backbone], trunk, heads)
    first, second = torch.rand(2, 70, 90, 3, generator=torch.Generator().manual_seed(1))
    found = metric.between(metric.features(first), metric.features(second))
    assert found == pytest.approx(_by_formula(backbone, first, second, torch.load(heads)), rel=1e-5)
    assert metric.between(metric.features(first), metric.features(first)) == 0


def test_other_files_are_refused(tmp_path: Path) -> None:
    files = _write(tmp_path, "lpips-alex")
    refuses("is not the file that torchvision published; give alexnet", lpips.load_lpips, files[0])
    refuses("no such file", lpips.load_lpips, tmp_path / "none.pth")
    refuses(r"damaged weights .*lpips==0\.1\.4", lpips.build_lpips, lpips.TRUNKS[1], *files)
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    refuses("damaged weights", lpips.build_lpips, lpips.TRUNKS[0], tmp_path / "bad.pth", files[1])


def test_the_command_shows_it_beside_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    metric = lpips.build_lpips(lpips.TRUNKS[0], *_write(tmp_path, "lpips-alex"))
    monkeypatch.setattr(scoring, "load_lpips", lambda path: metric)  # the random trunk for the published one
    random = np.random.default_rng(2)
    for folder in ("truth", "images"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "0.png"), random.integers(0, 255, (64, 64, 3)).astype(np.uint8))
    shutil.copy(tmp_path / "truth/0.png", tmp_path / "truth/1.png")
    shutil.copy(tmp_path / "truth/0.png", tmp_path / "images/1.png")
    command = ["evaluate", "images", str(tmp_path / "images"), str(tmp_path / "truth")]
    out = tmp_path / "scores.json"
    assert main([*command, "--lpips-weights", str(tmp_path / "trunk.pth"), "--no-perceptual", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert ", LPIPS 0." in shown
    assert "ST-LPIPS" not in shown
    scores = read_json(out, "mien.scores", 1)
    assert scores["lpips_backbone"] == "lpips-alex"
    assert scores["per_frame"]["lpips"][1] == 0 < scores["per_frame"]["lpips"][0]
    assert "--lpips-weights" in complaint(capsys, *command, "--lpips-weights", str(tmp_path / "none"))


def _flat(height: int, width: int, value: int) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_levels_are_rounded_pictures_shrunk_and_errors_shown_up_to_a_limit() -> None:
    image = torch.tensor([[[-0.5, 0.5, 1.5], [0.0, 1.0, 1 / 255]]])
    assert to_uint8(image).tolist() == [[[0, 128, 255], [0, 255, 1]]]
    assert shrink(_flat(100, 50, 3), 40).shape == (40, 20, 3)
    assert shrink(_flat(10, 5, 3), 40).shape == (10, 5, 3), "nothing is enlarged"
    target = torch.zeros(1, 4, 3)
    image = torch.tensor([0.0, 0.1, 0.2, 0.9])[None, :, None].expand(1, 4, 3)
    heat = error_heat(image, target, limit=0.2)
    assert heat[0, 0].tolist() == heat_colors(np.zeros((1, 1), np.float32))[0, 0].tolist()
    assert heat[0, 2].tolist() == heat[0, 3].tolist() == heat_colors(np.ones((1, 1), np.float32))[0, 0].tolist()
    brightness = heat.astype(int).sum(-1)[0]
    assert brightness[0] < brightness[1] < brightness[2]


def test_sheets_and_uris_hold_their_pictures() -> None:
    joined = side_by_side([_flat(10, 8, 0), _flat(20, 30, 100)], gap=2)
    assert joined.shape == (10, 8 + 2 + 15, 3)
    assert (joined[:, :8] == 0).all()
    assert (joined[:, 8:10] == 255).all()
    assert (joined[:, 10:] == 100).all()
    sheet = picture_grid([_flat(4, 6, value) for value in (10, 20, 30)], columns=2, gap=1)
    assert (sheet.shape, sheet[0, 7, 0], sheet[5, 0, 0]) == ((9, 13, 3), 20, 30)
    assert (sheet[5:, 7:] == 255).all()
    picture = np.random.default_rng(0).integers(0, 255, (12, 9, 3)).astype(np.uint8)
    for quality in (None, 95):
        head, body = picture_uri(picture, quality).split(",")
        assert head == f"data:image/{'png' if quality is None else 'jpeg'};base64"
        decoded = cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR_RGB)
        assert decoded is not None
        assert decoded.shape == picture.shape
        if quality is None:
            assert (decoded == picture).all()
