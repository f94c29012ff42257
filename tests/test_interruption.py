"""After Ctrl-C or kill during rendering or scoring, nothing is half-written, and the same command ends alike."""

import importlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from forked import Forked, ForkServer
from mien.capture.video import read_video_frames
from mien.cli import main
from mien.commands.stages import pictures
from mien.evaluation.partial import PartialScores
from toy_workspace import write_toy_workspace

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
FRAMES = 6
LOOK = ["--frames", str(FRAMES), "--size", "32"]
EVALUATE = ["--no-perceptual", "--json"]
CODES = {signal.SIGKILL: -signal.SIGKILL, signal.SIGTERM: 143, signal.SIGINT: 130}


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interrupted") / "workspace"
    write_toy_workspace(folder, timesteps=20)
    return folder


def stop(server: ForkServer, words: list[str], steps: int, how: signal.Signals) -> Forked:
    """Run a command to its end in another process that gets a signal when this many pictures are done."""
    process = server.call("test_interruption:stop_itself", words, steps, int(how), exits=True)
    process.wait()
    return process


def stop_itself(words: list[str], steps: int, number: int) -> int:
    done = 0

    def counted(original: Callable[..., Any]) -> Callable[..., Any]:
        def step(*arguments: Any) -> Any:
            nonlocal done
            result = original(*arguments)
            done += 1
            if done == steps:
                os.kill(os.getpid(), number)
            return result

        return step

    pictures.draw, PartialScores.add = counted(pictures.draw), counted(PartialScores.add)
    return main(words)


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def content(path: Path) -> list[bytes]:
    """Return the bytes of a file. A .webm holds a random number, so that its pictures are returned."""
    if path.suffix == ".webm":
        return [frame.tobytes() for _, frame in read_video_frames(path)]
    return [path.read_bytes()]


@pytest.mark.parametrize(("name", "how"), [
    ("a.mp4", signal.SIGKILL),
    ("a.webm", signal.SIGINT),
    ("a.png", signal.SIGINT),
    ("a_%06d.png", signal.SIGTERM),
    ("pictures", signal.SIGKILL),
])  # fmt: skip
def test_stopped_rendering_ends_alike_the_next_time(
    name: str, how: signal.Signals, fork_server: ForkServer, workspace: Path, tmp_path: Path
) -> None:
    """A stopped rendering leaves the old file until the new one is whole. Every numbered picture is whole."""
    command = ["render", str(workspace), *LOOK, "--out"]
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    assert main([*command, str(undisturbed / name)]) == 0
    several = name in ("a_%06d.png", "pictures")
    if not several:
        out.mkdir()
        (out / name).write_text("mine")
    stopped = stop(fork_server, [*command, str(out / name)], 1 if name == "a.png" else 3, how)
    assert stopped.poll() == CODES[how]
    assert ("the same command" in stopped.stderr) == (how != signal.SIGKILL)
    folder = out / "pictures" if name == "pictures" else out
    if several:
        assert len(visible(folder)) == 2
        assert all(cv2.imread(str(folder / each)) is not None for each in visible(folder))
    else:
        assert visible(folder) == [name]
        assert (out / name).read_text() == "mine"
    assert how == signal.SIGKILL or len(visible(folder)) == len(list(folder.iterdir())), "something half-written stays"
    assert main([*command, str(out / name)]) == 0
    files = [path for path in undisturbed.rglob("*") if path.is_file()]
    assert len(files) == (FRAMES if several else 1)
    assert all(content(out / path.relative_to(undisturbed)) == content(path) for path in files)


@pytest.fixture(scope="module")
def evaluated(workspace: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace whose run was scored undisturbed."""
    folder = shutil.copytree(workspace, tmp_path_factory.mktemp("evaluated") / "workspace")
    assert main(["evaluate", str(folder), *EVALUATE]) == 0
    return folder


def figures(workspace: Path) -> dict[str, Any]:
    entry = json.loads((workspace / "runs/toy/metrics.json").read_text())["protocols"]["self_reenactment_tail"]
    return {name: value for name, value in entry.items() if name != "seconds_per_frame"}


def test_killed_scoring_goes_on(fork_server: ForkServer, workspace: Path, evaluated: Path, tmp_path: Path) -> None:
    killed = shutil.copytree(workspace, tmp_path / "killed")
    run = killed / "runs" / "toy"
    before = visible(run)
    stop(fork_server, ["evaluate", str(killed), *EVALUATE], 2, signal.SIGKILL)
    assert visible(run) == before, "figures of a part of the frames"
    assert len((run / ".self_reenactment_tail.partial").read_text().splitlines()) >= 3
    assert main(["evaluate", str(killed), *EVALUATE]) == 0
    assert figures(killed) == figures(evaluated)
    assert not list(run.glob(".*.partial"))


def test_figures_stay_whole_where_the_report_is_interrupted(evaluated: Path, tmp_path: Path, monkeypatch) -> None:
    folder = shutil.copytree(evaluated, tmp_path / "w")
    run = folder / "runs/toy"
    before = (run / "metrics.json").read_bytes()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    for part in ("write_report", "write_comparison_video"):
        with monkeypatch.context() as patched:
            patched.setattr(importlib.import_module("mien.evaluation.evaluate"), part, interrupted)
            assert main(["evaluate", str(folder), *EVALUATE]) == 130
        assert (run / "metrics.json").read_bytes() == before
    assert main(["evaluate", str(folder), *EVALUATE]) == 0
    assert [path.name for path in run.rglob(".*")] == []
