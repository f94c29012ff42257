"""The scripts in examples/ and the code in docs/api.md run as they are, on little data."""

import json
import re
import runpy
import sys
from functools import partial
from pathlib import Path

import pytest

from mien import tracking
from mien.cli import main
from mien.tracking import PhotometricSettings, TrackingSettings

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
ROOT = Path(__file__).parents[1]
SUBJECT = "out/examples/subject"


def run_script(name: str, folder: Path, *arguments: str) -> None:
    """Run a script as Python does, in a folder."""
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    run_script("03_synthetic_capture.py", folder, "--out", SUBJECT, "--seconds", "0.24", "--size", "64")
    return folder


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    run_script("05_train_and_evaluate.py", folder, SUBJECT, "--steps", "20", "--gaussians", "9000")
    return folder


@pytest.fixture
def short_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `mien.tracking.track` take few keyframes and steps where it is given no settings."""
    pixels = PhotometricSettings(keyframes=4, sizes=(64, 64), texture_size=128, shared_steps=1)
    few = TrackingSettings(keyframes=4, photometric=pixels)
    monkeypatch.setattr(tracking, "track", partial(tracking.track, settings=few))


def test_fit_gaussians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_script("01_fit_gaussians.py", tmp_path, "--out", "fit.png", "--steps", "60")
    printed = capsys.readouterr().out
    errors = [float(line.split()[-1]) for line in printed.splitlines() if line.startswith("step")]
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fit.png").is_file()


def test_face_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_script("02_face_model.py", tmp_path, "--out", "face.png", "--size", "64")
    assert "jawOpen" in capsys.readouterr().out


@pytest.mark.usefixtures("short_tracking")
def test_capture_and_track(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # A drawn head with lines over it is still a face.
    overlay = f"{SUBJECT}/sequences/synthetic/tracking/overlay.mp4"
    run_script("04_capture_and_track.py", folder, overlay, "--out", "out/examples/me", "--max-frames", "6")
    assert "landmark residual" in capsys.readouterr().out
    assert (folder / "out/examples/me/sequences/overlay/tracking/overlay.mp4").is_file()


def test_training_by_the_example_and_by_the_command_gives_the_same_bytes(trained: Path) -> None:
    metrics = json.loads((trained / SUBJECT / "runs/example/metrics.json").read_text())
    assert metrics["protocols"]["self_reenactment"]["head"]["psnr"] > 0
    options = ("--run", "by_command", "--steps", "20", "--method.density.max-gaussians", "9000")
    assert main(["train", str(trained / SUBJECT), *options]) == 0
    by_example, by_command = (trained / SUBJECT / "runs" / name for name in ("example", "by_command"))
    for name in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (by_example / name).read_bytes() == (by_command / name).read_bytes(), name
    configs = [json.loads((run / "config.json").read_text(encoding="utf-8")) for run in (by_example, by_command)]
    assert all(configs[0][part] == configs[1][part] for part in ("method", "settings", "data"))


def test_the_avatar_is_drawn_driven_and_run_without_torch(trained: Path) -> None:
    run_script("06_render_expressions.py", trained, SUBJECT, "--run", "example", "--out", "e.png", "--size", "48")
    run_script("07_drive.py", trained, SUBJECT, "--by", SUBJECT, "--run", "example", "--out", "driven.mp4")
    for name in ("e.png", "driven.mp4"):
        assert (trained / name).stat().st_size > 1000
    assert main(["export", str(trained / SUBJECT), "--run", "example", "--out", str(trained / "avatar.mien")]) == 0
    run_script("08_runtime.py", trained, "avatar.mien", "--out", "frames", "--frames", "3", "--size", "48")
    assert len(list((trained / "frames").glob("*.png"))) == 3


@pytest.mark.usefixtures("short_tracking")
def test_api_page(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 10
    monkeypatch.chdir(folder)
    exec("\n".join(blocks), {"__name__": "__main__"})
    assert "Gaussians" in capsys.readouterr().out
