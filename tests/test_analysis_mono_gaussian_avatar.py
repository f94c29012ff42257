"""`mien analyze mono-gaussian-avatar`: every part runs and writes its files; subsets are what they say."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import train_toy
from mien.avatar import Avatar, load_avatar
from mien.cli import main
from mien.lab.analysis import mono_gaussian_avatar
from mien.lab.analysis import mono_gaussian_avatar as analysis
from mien.training import TrainSettings
from mien.training.footage.frames import training_frames
from plain_settings import plain_mono_gaussian_avatar
from shared_things import MadeOnce, write_toy_workspace
from toy_scene import toy_sequence

pytestmark = pytest.mark.unchecked
CONFIG = plain_mono_gaussian_avatar(points=60, max_points=120, epochs=10)


@pytest.fixture
def toy(made_once: MadeOnce) -> Path:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(train_toy, "CONFIG", CONFIG)
        return made_once("analysis_mono", write_toy_workspace)


@pytest.fixture
def workspace(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(mono_gaussian_avatar, "SIDE", 16)
    return Path(shutil.copytree(toy, tmp_path / "W"))


def analyze(root: Path, *more: str) -> dict[str, Any]:
    assert main(["analyze", "mono-gaussian-avatar", str(root), *more]) == 0
    return json.loads((root / "analysis/toy/analysis.json").read_text())["parts"]


def test_times_stand_beside_the_papers(workspace: Path) -> None:
    part = analyze(workspace, "--seconds", "0.01")
    assert list(part) == ["times"]
    times, rows = part["times"]["values"]["frame_ms"], part["times"]["tables"][0]["rows"]
    assert {name: value > 0 for name, value in times.items()} == {"networks": True, "baked": True}
    assert rows[-1][:3] == ["paper: MonoGaussianAvatar", 9.0, 30.0]
    assert rows[-4][:3] == ["paper: NeRFace", 48.0, 2000.0]


@pytest.mark.slow
def test_short_trainings_write_their_pictures(workspace: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    # As in the paper: 0.0025 m from the middle between 512 and 1024 pixels on, which is at 724.
    assert [analysis.scale_gain(side) for side in (128, 512, 720, 730, 1024, 2048)] == 3 * [0.00625] + 3 * [0.0025]
    monkeypatch.setattr(mono_gaussian_avatar, "GAINS", {16: 0.004, 32: 0.00625})
    asked = ("--parts", "convergence", "resolutions", "diversity", "--steps", "10")
    parts = analyze(workspace, *asked)
    assert "diversity: 5 trainings of 10 steps each" in capsys.readouterr().err
    files = ("convergence.png", "convergence-psnr.svg", "convergence-points.svg", "resolutions.png", "diversity.png")
    assert all((workspace / "analysis/toy" / name).is_file() for name in files)
    shown, sides, subsets = (parts[name]["values"]["rows"] for name in ("convergence", "resolutions", "diversity"))
    assert [row["step"] for row in shown] == [1, 2, 5, 10]
    assert [(row["side"], row["scale_gain"]) for row in sides] == [(32, 0.00625), (16, 0.004)]
    runs = (workspace / "analysis/toy/runs").glob("resolution-*")
    gains = {one.name.split("-")[1]: load_avatar(one).config.scale_gain for one in runs}  # type: ignore[attr-defined]
    assert gains == {"16": 0.004, "32": 0.00625}
    clips = [("frontal clip", 1), ("mixed clip", 2)]
    wanted = [("all frames", 4), *clips, ("frontal quarter", 1), ("mixed half", 2)]
    assert [(row["name"], row["timesteps"]) for row in subsets] == wanted
    assert [len({row["head_psnr"] for row in rows}) for rows in (shown, sides)] == [4, 2]
    assert subsets[0]["head_psnr"] == sides[0]["head_psnr"], "all frames at full size is the same training in both"
    assert analyze(workspace, *asked) == parts
    # A capture with more pixels than the paper's is trained at the paper's two sizes.
    monkeypatch.setattr(mono_gaussian_avatar, "GAINS", {16: 0.004, 24: 0.00625})
    shutil.rmtree(workspace / "analysis")
    sides = analyze(workspace, "--parts", "resolutions", "--steps", "2")["resolutions"]["values"]["rows"]
    assert [(row["side"], row["scale_gain"]) for row in sides] == [(24, 0.00625), (16, 0.004)]


@pytest.mark.slow
def test_convergence_trains_as_the_run_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With steps before the first picture, as the presets `draft` and `standard` have them."""
    monkeypatch.setattr(train_toy, "CONFIG", plain_mono_gaussian_avatar(points=60, max_points=120, pretraining=7))
    write_toy_workspace(tmp_path / "W")
    seen: list[dict[str, torch.Tensor]] = []

    def drawn(avatar: Avatar, *_: Any) -> torch.Tensor:
        seen.append({name: tensor.clone() for name, tensor in avatar.state_dict().items()})
        return torch.full((32, 32, 3), 0.5)

    monkeypatch.setattr(mono_gaussian_avatar, "drawn", drawn)
    analyze(tmp_path / "W", "--parts", "convergence", "--steps", str(train_toy.SETTINGS.steps))
    trained = load_avatar(tmp_path / "W" / "runs" / "toy").state_dict()
    assert trained.keys() == seen[-1].keys()
    for name, tensor in trained.items():
        assert torch.equal(tensor, seen[-1][name]), name


def test_times_and_stages_on_a_device(workspace: Path, elsewhere: set[str]) -> None:
    parts = analyze(
        workspace, "--parts", "times", "convergence", "--steps", "2", "--seconds", "0.01", "--device", "auto"
    )
    assert parts["convergence"]["values"]["rows"][-1]["head_psnr"] > 0
    assert "float64" in elsewhere


def measured(angles: np.ndarray, expressions: np.ndarray) -> analysis.Measured:
    return analysis.Measured(tuple((0, index) for index in range(len(angles))), angles, expressions)


def test_the_mixed_half_keeps_what_is_rare() -> None:
    angles, expressions = np.zeros((22, 2)), np.zeros((22, 3))
    angles[20, 0], expressions[21, 1] = 1.0, 4.0
    whole = measured(angles, expressions)
    chosen = analysis.mixed_half(whole)
    assert len(chosen) == len(set(chosen)) == 11
    assert {20, 21} <= set(chosen)
    assert analysis.ranges(whole, chosen)["yaw_range"] > analysis.ranges(whole, list(range(20)))["yaw_range"] == 0
    # Subsets are chosen among the frames of the training.
    _, sequence = toy_sequence(10, 32)
    frames = training_frames([sequence], TrainSettings(split="tail"))
    found = analysis.measure([sequence], frames)
    assert found.timesteps == tuple((0, index) for index in range(8))
    assert found.expressions.std(0)[sequence.tracking.face.expression[:8].std(0).numpy() > 0] == pytest.approx(1)
    (mask,) = analysis.masks([sequence], found, [0, 3])
    assert mask.nonzero()[:, 0].tolist() == [0, 3]
    assert analysis.ranges(found, list(range(8)))["expression_spread"] == pytest.approx(1)


def test_the_frontal_quarter_has_the_views_nearest_to_the_median():
    yaws = np.array([-0.9, 0.05, 0.8, 0.0, -0.05, 0.7, -0.8, 0.02])
    whole = measured(np.stack([yaws, 0 * yaws], 1), np.zeros((8, 1)))
    assert analysis.frontal_quarter(whole) == [3, 7]
    # Clips are successive timesteps, whatever lies between the best ones.
    assert analysis.clip(whole, 0.25, mixed=False) == [3, 4]
    assert analysis.clip(whole, 0.5, mixed=True) == [0, 1, 2, 3]
    assert analysis.clip(whole, 0.25, mixed=True) == [5, 6]
