"""Exact LPIPS is the published formula on the user's files, and stands beside ST-LPIPS under its own name."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from mien.cli import main
from mien.errors import UserError
from mien.evaluation import scoring
from mien.perceptual import lpips
from mien.storage import read_json

CHANNELS = (64, 192, 384, 256, 256)


def _trunk() -> nn.Sequential:
    """Return AlexNet's convolutions in torchvision's order, with random weights."""
    torch.manual_seed(3)
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(),
        nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return files of a trunk and of factors, as they are published. AlexNet's second convolution has padding 2."""
    folder = tmp_path_factory.mktemp("lpips")
    torch.save({f"features.{name}": value for name, value in _trunk().state_dict().items()}, folder / "trunk.pth")
    torch.manual_seed(4)
    torch.save({f"lin{k}.model.1.weight": torch.rand(1, c, 1, 1) for k, c in enumerate(CHANNELS)}, folder / "heads.pth")
    return folder / "trunk.pth", folder / "heads.pth"


def _by_formula(first: Tensor, second: Tensor, heads: dict[str, Tensor]) -> float:
    """Return LPIPS as the paper and its package define it."""
    trunk, total = _trunk(), 0.0
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    values = [((2 * image - 1 - shift) / scale).permute(2, 0, 1)[None] for image in (first, second)]
    tap = 0
    with torch.no_grad():
        for layer in trunk:
            values = [layer(value) for value in values]
            if isinstance(layer, nn.ReLU):
                unit = [value / (value.square().sum(1, keepdim=True).sqrt() + 1e-10) for value in values]
                weighted = (unit[0] - unit[1]).square() * heads[f"lin{tap}.model.1.weight"]
                total += float(weighted.sum(1).mean())
                tap += 1
    assert tap == len(CHANNELS)
    return total


def test_it_is_the_published_formula(files: tuple[Path, Path]) -> None:
    metric = lpips.build_lpips(lpips._TRUNKS[0], *files)
    first, second = torch.rand(2, 70, 90, 3, generator=torch.Generator().manual_seed(1))
    found = metric.between(metric.features(first), metric.features(second))
    assert found == pytest.approx(_by_formula(first, second, torch.load(files[1])), rel=1e-5)
    assert metric.between(metric.features(first), metric.features(first)) == 0


def test_other_files_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not the file that torchvision published; give alexnet"):
        lpips.load_lpips(files[0])
    with pytest.raises(UserError, match="no such file"):
        lpips.load_lpips(tmp_path / "none.pth")
    with pytest.raises(UserError, match=r"damaged weights .*lpips==0\.1\.4"):
        lpips.build_lpips(lpips._TRUNKS[1], *files)
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    with pytest.raises(UserError, match="damaged weights"):
        lpips.build_lpips(lpips._TRUNKS[0], tmp_path / "bad.pth", files[1])


@pytest.fixture
def exact(files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Take the random trunk for the published one."""
    metric = lpips.build_lpips(lpips._TRUNKS[0], *files)
    monkeypatch.setattr(scoring, "load_lpips", lambda path: metric)
    return files[0]


def test_the_command_shows_it_beside_the_others(
    exact: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(2)
    for folder in ("truth", "images"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "0.png"), random.integers(0, 255, (64, 64, 3)).astype(np.uint8))
    shutil.copy(tmp_path / "truth/0.png", tmp_path / "truth/1.png")
    shutil.copy(tmp_path / "truth/0.png", tmp_path / "images/1.png")
    command = ["evaluate", "--images", str(tmp_path / "images"), "--truth", str(tmp_path / "truth")]
    out = tmp_path / "scores.json"
    assert main([*command, "--lpips-weights", str(exact), "--no-perceptual", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert ", LPIPS 0." in shown
    assert "ST-LPIPS" not in shown
    scores = read_json(out, "mien.scores", 1)
    assert scores["lpips_backbone"] == "lpips-alex"
    assert scores["per_frame"]["lpips"][1] == 0 < scores["per_frame"]["lpips"][0]
    assert main([*command, "--lpips-weights", str(tmp_path / "none")]) == 2
    assert "--lpips-weights" in capsys.readouterr().err
