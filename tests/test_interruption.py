"""After Ctrl-C or kill during rendering or scoring, nothing is half-written, and the same command ends alike."""

import importlib
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mien.capture.video import read_video_frames
from mien.cli import main
from mien.commands.stages import pictures
from toy_workspace import write_toy_workspace

FRAMES = 6
LOOK = ["--frames", str(FRAMES), "--size", "32"]
EVALUATE = ["--no-perceptual", "--json"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}
SLOWLY = """
import signal, sys, time
from mien.capture.video import read_video_frames
from mien.cli import main
from mien.commands.stages import pictures
from mien.evaluation.partial import PartialScores

def slowed(original):
    def step(*arguments):
        result = original(*arguments)
        print("step", flush=True)
        time.sleep(0.3)
        return result
    return step

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell starts in the background
pictures.draw, PartialScores.add = slowed(pictures.draw), slowed(PartialScores.add)
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interrupted") / "workspace"
    write_toy_workspace(folder, timesteps=20)
    return folder


def stop(arguments: list[str], steps: int, how: signal.Signals) -> int:
    """Run the command in another process until this many pictures are done, then send it a signal."""
    with subprocess.Popen([sys.executable, "-c", SLOWLY, *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for _ in range(steps):
            while process.stdout.readline() not in ("step\n", ""):
                pass
        process.send_signal(how)
        return process.wait(timeout=60)


def decoded(video: Path) -> list[bytes]:
    return [frame.tobytes() for _, frame in read_video_frames(video)]


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.png", "a_%06d.png"])
def test_interrupted_rendering(
    name: str, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An interrupted rendering leaves the old file until the new one is whole. Every numbered picture is whole."""
    command = ["render", str(workspace), *LOOK, "--out"]
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    assert main([*command, str(undisturbed / name)]) == 0
    numbered = "%" in name
    if not numbered:
        out.mkdir()
        (out / name).write_text("mine")
    original, last = pictures.draw, 1 if name == "a.png" else 3
    calls = iter(range(1, 100))

    def interrupted(*arguments: Any) -> np.ndarray:
        if next(calls) == last:
            raise KeyboardInterrupt
        return original(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(pictures, "draw", interrupted)
        assert main([*command, str(out / name)]) == 130
    assert "the same command" in capsys.readouterr().err
    assert sorted(path.name for path in out.iterdir()) == (["a_000000.png", "a_000001.png"] if numbered else [name]), (
        "something half-written stays"
    )
    if not numbered:
        assert (out / name).read_text() == "mine"
    assert main([*command, str(out / name)]) == 0
    # A .webm holds a random number; its pictures are compared.
    content = decoded if name == "a.webm" else Path.read_bytes
    assert [content(path) for path in sorted(out.iterdir())] == [
        content(path) for path in sorted(undisturbed.iterdir())
    ]


@pytest.mark.parametrize(
    ("name", "how"), [("a.mp4", signal.SIGKILL), ("a.mp4", signal.SIGTERM), ("pictures", signal.SIGINT)]
)
def test_stopped_rendering_ends_alike_the_next_time(
    name: str, how: signal.Signals, workspace: Path, tmp_path: Path
) -> None:
    command, out = ["render", str(workspace), *LOOK, "--out"], tmp_path / "out" / name
    assert stop([*command, str(out)], 2, how) == CODES[how]
    assert visible(tmp_path / "out") == (["pictures"] if name == "pictures" else [])
    for path in out.glob("[0-9]*.png"):
        assert cv2.imread(str(path)) is not None
    undisturbed = tmp_path / "undisturbed" / name
    for place in (out, undisturbed):
        assert main([*command, str(place)]) == 0
    files = sorted(undisturbed.iterdir()) if name == "pictures" else [undisturbed]
    assert len(files) == (FRAMES if name == "pictures" else 1)
    for path in files:
        assert path.read_bytes() == (tmp_path / "out" / path.relative_to(tmp_path / "undisturbed")).read_bytes()


def test_killed_scoring_goes_on(workspace: Path, tmp_path: Path) -> None:
    for name in ("undisturbed", "killed"):
        shutil.copytree(workspace, tmp_path / name)
    assert main(["evaluate", str(tmp_path / "undisturbed"), *EVALUATE]) == 0
    run = tmp_path / "killed" / "runs" / "toy"
    before = visible(run)
    assert stop(["evaluate", str(tmp_path / "killed"), *EVALUATE], 2, signal.SIGKILL) == -signal.SIGKILL
    assert visible(run) == before, "figures of a part of the frames"
    assert len((run / ".self_reenactment_tail.partial").read_text().splitlines()) >= 3
    assert main(["evaluate", str(tmp_path / "killed"), *EVALUATE]) == 0
    figures = []
    for name in ("undisturbed", "killed"):
        content = json.loads((tmp_path / name / "runs/toy/metrics.json").read_text())
        figures.append(content["protocols"]["self_reenactment_tail"])
        del figures[-1]["seconds_per_frame"]
    assert figures[0] == figures[1]
    assert not list(run.glob(".*.partial"))


@pytest.mark.parametrize("part", ["write_report", "write_comparison_video"])
def test_figures_stay_whole_where_the_report_is_interrupted(
    part: str, workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(workspace, tmp_path / "w")
    run = tmp_path / "w/runs/toy"
    assert main(["evaluate", str(tmp_path / "w"), *EVALUATE]) == 0
    before = (run / "metrics.json").read_bytes()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(importlib.import_module("mien.evaluation.evaluate"), part, interrupted)
        assert main(["evaluate", str(tmp_path / "w"), *EVALUATE]) == 130
    assert (run / "metrics.json").read_bytes() == before
    assert main(["evaluate", str(tmp_path / "w"), *EVALUATE]) == 0
    assert [path.name for path in run.rglob(".*")] == []
