"""The scripts in examples/ and the code in docs/api.md run as they are, on little data."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mien.cli import main

ROOT = Path(__file__).parents[1]
SUBJECT = "out/examples/subject"


def run_script(folder: Path, *arguments: str) -> str:
    environment = {**os.environ, "MIEN_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def example(name: str) -> str:
    return str(ROOT / "examples" / name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples")
    run_script(folder, example("03_synthetic_capture.py"), "--out", SUBJECT, "--seconds", "0.8", "--size", "128")
    return folder


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    options = ("--steps", "40", "--gaussians", "9000")
    assert "dB head crop" in run_script(folder, example("05_train_and_evaluate.py"), SUBJECT, *options)
    return folder


def test_fit_gaussians(tmp_path: Path) -> None:
    printed = run_script(tmp_path, example("01_fit_gaussians.py"), "--out", "fit.png", "--steps", "60")
    errors = [float(line.split()[-1]) for line in printed.splitlines() if line.startswith("step")]
    assert errors[-1] < 0.3 * errors[0]
    assert (tmp_path / "fit.png").is_file()


def test_face_model(tmp_path: Path) -> None:
    assert "jawOpen" in run_script(tmp_path, example("02_face_model.py"), "--out", "face.png", "--size", "64")


@pytest.mark.slow
def test_capture_and_track(folder: Path) -> None:
    # A drawn head with lines over it is still a face.
    overlay = f"{SUBJECT}/sequences/synthetic/tracking/overlay.mp4"
    printed = run_script(folder, example("04_capture_and_track.py"), overlay, "--out", "out/examples/me")
    assert "landmark residual" in printed


@pytest.mark.slow
def test_render_expressions(trained: Path) -> None:
    run_script(
        trained, example("06_render_expressions.py"), SUBJECT, "--run", "example", "--out", "e.png", "--size", "48"
    )
    assert (trained / "e.png").stat().st_size > 1000


@pytest.mark.slow
def test_drive(trained: Path) -> None:
    run_script(trained, example("07_drive.py"), SUBJECT, "--by", SUBJECT, "--run", "example", "--out", "driven.mp4")
    assert (trained / "driven.mp4").stat().st_size > 1000


@pytest.mark.slow
def test_training_by_the_example_and_by_the_command_gives_the_same_bytes(trained: Path) -> None:
    options = ("--run", "by_command", "--steps", "40", "--method.density.max-gaussians", "9000")
    assert main(["train", str(trained / SUBJECT), *options]) == 0
    by_example, by_command = (trained / SUBJECT / "runs" / name for name in ("example", "by_command"))
    for name in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (by_example / name).read_bytes() == (by_command / name).read_bytes(), name
    configs = [json.loads((run / "config.json").read_text(encoding="utf-8")) for run in (by_example, by_command)]
    assert all(configs[0][part] == configs[1][part] for part in ("method", "settings", "data"))


@pytest.mark.slow
def test_runtime(trained: Path) -> None:
    assert main(["export", str(trained / SUBJECT), "--run", "example", "--out", str(trained / "avatar.mien")]) == 0
    run_script(trained, example("08_runtime.py"), "avatar.mien", "--out", "frames", "--frames", "3", "--size", "48")
    assert len(list((trained / "frames").glob("*.png"))) == 3


@pytest.mark.slow
def test_api_page(folder: Path) -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 10
    assert "Gaussians" in run_script(folder, "-c", "\n".join(blocks))


def test_every_example_is_short_and_listed() -> None:
    listed = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    for script in sorted((ROOT / "examples").glob("*.py")):
        assert 30 <= len(script.read_text(encoding="utf-8").splitlines()) <= 80, script
        assert script.name in listed
