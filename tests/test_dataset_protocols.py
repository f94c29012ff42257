"""Protocols of datasets: their pixels, their frames, their window of SSIM and their LPIPS."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from evaluation_case import make_experiment, two_cameras, write_run, write_sequence
from mien.capture import read_capture
from mien.capture.store import read_capture_hash
from mien.commands.evaluate import Protocol
from mien.disk.files import write_arrays, write_json
from mien.errors import UserError
from mien.evaluation import dataset_protocols, evaluate, scoring
from mien.evaluation.dataset_protocols import DATASET_PROTOCOLS, dataset_protocol
from mien.evaluation.experiment import avatar_image, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import ssim, ssim_map
from mien.evaluation.protocols import EvaluationSettings
from mien.tracking.scoring_files import read_scoring, write_scoring
from mien.training.footage.clothes import FOREIGN, packed_clothes
from mien.training.footage.frames import Frame
from mien.training.settings.splits import OwnSplit, write_own_split
from plain_settings import plain_run

pytestmark = pytest.mark.unchecked
PLAIN = EvaluationSettings(perceptual=False, baselines=False, video_frames=0, edges="filmed")


def test_windows_inside_the_picture() -> None:
    first, second = torch.rand(2, 40, 33, 3, generator=torch.Generator().manual_seed(1))
    inner = ssim_map(first, second)[5:-5, 5:-5]
    assert ssim(first, second, "inside") == pytest.approx(float(inner.mean()), abs=1e-6)
    assert abs(ssim(first, second) - float(inner.mean())) > 1e-4, "zeros beyond the border differ"
    small = first[:10], second[:10]
    assert ssim(*small, "inside") == ssim(*small)
    # The border of the protocol is scored.
    border = {each.name: EvaluationSettings(protocol=each.name).border for each in DATASET_PROTOCOLS}
    assert border == {**dict.fromkeys(get_args(Protocol), "zeros"), "imavatar": "inside"}
    assert EvaluationSettings().border == "zeros"
    image, truth = torch.rand(2, 30, 30, 3, generator=torch.Generator().manual_seed(0))
    rows = [scoring.score_pictures({"a": image}, truth, None, None, border=each)["a"] for each in ("zeros", "inside")]
    assert rows[0]["ssim"] != rows[1]["ssim"]
    assert rows[0]["psnr"] == rows[1]["psnr"]


def test_lpips_by_the_network_of_other_papers_is_refused(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset_protocols, "lpips_metric", lambda settings: SimpleNamespace(backbone="lpips-vgg"))
    settings = EvaluationSettings(protocol="imavatar", lpips_weights=Path("vgg16.pth"))
    with pytest.raises(UserError, match="gives lpips-vgg, and --protocol imavatar reports lpips-alex"):
        evaluate(root / "runs" / "views", [root / "sequences" / "EXP-2-eyes"], settings)
    dataset_protocols.check_lpips(dataset_protocol("insta"), settings)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace of two sequences with two cameras, and a run that holds out FREE and the camera `side`."""
    root, experiment = tmp_path_factory.mktemp("person") / "393", make_experiment(10)
    folders = [write_sequence(root, experiment, two_cameras(experiment, name)) for name in FOLDERS]
    settings = plain_run(steps=2, record_every=1, checkpoint_every=2, split="nersemble-benchmark")
    held = replace(settings, held_out_sequences=("FREE",), held_out_cameras=("side",))
    write_run(root / "runs" / "views", experiment, folders, held)
    return root


FOLDERS = ("EXP-2-eyes", "FREE")


def imported(folder: Path, dataset: str) -> None:
    write_own_split(folder, OwnSplit(), {"imported": {"dataset": dataset, "from": "there"}})


def of_dataset(root: Path, tmp_path: Path, dataset: str, split: str) -> tuple[Path, list[Path]]:
    """Return a copy of the run with another split, and its sequences as those of a dataset."""
    root = Path(shutil.copytree(root, tmp_path / "393"))
    run, folders = root / "runs" / "views", [root / "sequences" / name for name in FOLDERS]
    config = json.loads((run / "config.json").read_text())
    config["settings"]["split"] = split
    content = {name: value for name, value in config.items() if name not in ("format", "version", "checksum")}
    write_json(run / "config.json", config["format"], config["version"], content)
    for folder in folders:
        imported(folder, dataset)
    return run, folders


def test_the_benchmark_counts_test_sequences_in_its_four_cameras(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [root / "sequences" / name for name in FOLDERS]
    for folder in folders:
        imported(folder, "nersemble-benchmark")
    assert set(load_experiments(root / "runs" / "views", folders)) == {"self_reenactment_sequence", "novel_view"}
    monkeypatch.setattr(dataset_protocols, "TEST_CAMERAS", ("front",))
    found = load_experiments(root / "runs" / "views", folders, "filmed", "nersemble-benchmark")
    assert set(found) == {"self_reenactment_sequence"}
    experiment = found["self_reenactment_sequence"]
    assert set(experiment.held_out_frames) == {Frame(1, t, 0) for t in range(10)}
    assert experiment.whole_mattes


def test_raw_recordings_are_cut_at_the_neck_line(root: Path, tmp_path: Path) -> None:
    run, folders = of_dataset(root, tmp_path, "nersemble", "gaussian-avatars")
    with pytest.raises(UserError, match=r"are cut at a plane.*delete .*scoring and run `mien track` with --scoring.c"):
        load_experiments(run, folders, "filmed", "nersemble")
    for folder in folders:
        found = read_scoring(folder / "scoring", read_capture_hash(folder / "capture"))
        masks = np.asarray(found.masks).copy()
        masks[..., masks.shape[2] // 2 :, :] = 0
        shutil.rmtree(folder / "scoring")
        cut = replace(found, masks=masks, cut="line")
        write_scoring(folder / "scoring", cut, read_capture_hash(folder / "capture"))
    protocols = evaluate(run, folders, replace(PLAIN, protocol="nersemble"))["protocols"]
    assert set(protocols) == {"self_reenactment_sequence", "novel_view"}
    assert protocols["novel_view"]["mask"].startswith("frozen scoring mask: matte above the neck line")
    assert protocols["novel_view"]["dataset_protocol"] == "nersemble"
    imported(folders[1], "vhap")
    with pytest.raises(UserError, match="was trained on nersemble and vhap, whose pixels are not scored alike"):
        load_experiments(run, folders, "filmed", "nersemble")


def test_imavatar_scores_drawings_that_are_opened_and_without_clothes(root: Path, tmp_path: Path) -> None:
    run, folders = of_dataset(root, tmp_path, "imavatar", "dataset")
    settings = replace(PLAIN, protocol="imavatar")
    plain = evaluate(run, folders, settings)["protocols"]["self_reenactment_sequence"]
    assert "without_clothes" not in plain, "nothing tells where clothes are"
    t, _, height, width = read_capture(folders[1] / "capture").mattes.shape
    rows = np.arange(height)[None, :, None] > height // 2
    write_arrays(folders[1] / FOREIGN, packed_clothes(np.broadcast_to(rows, (t, height, width))))
    found = evaluate(run, folders, settings)["protocols"]["self_reenactment_sequence"]
    assert found["psnr"] == plain["psnr"]
    assert found["opened"]["frames"] == found["without_clothes"]["frames"] == found["frames"]
    experiment = load_experiments(run, folders, "filmed", "imavatar")["self_reenactment_sequence"]
    figures = []
    for frame in experiment.held_out_frames:
        drawn, truth = (255 * avatar_image(experiment, frame)).round(), 255 * target_image(experiment, frame)
        dilated = max_pool2d(-max_pool2d(-drawn.permute(2, 0, 1), 3, 1, 1), 3, 1, 1).permute(1, 2, 0)
        upper = torch.stack([truth - dilated, truth - drawn])[:, : height // 2 + 1] / 255
        figures.append([float(-10 * (part.square().sum() / truth.numel()).log10()) for part in upper])
    means = np.mean(figures, axis=0)
    assert found["without_clothes"]["psnr"] == pytest.approx(means[0], abs=2e-3)
    assert abs(means[0] - means[1]) > 0.01, "eroding changes the figure"
    (folders[1] / FOREIGN).unlink()
    write_arrays(folders[1] / FOREIGN, packed_clothes(np.zeros((t, height, width - 8), bool)))
    with pytest.raises(UserError, match="its masks of clothes do not fit the pictures; import the sequence again"):
        load_experiments(run, folders, "filmed", "imavatar")
