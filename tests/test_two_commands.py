"""One of two commands on a workspace works, and the other names it, even if both start at once."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from capture_helpers import tree_bytes
from forked import ForkServer
from mien.cli import main
from mien.locks import lock_file
from other_process import Holder
from two_commands import RANK, Studio, beside, toy_studio

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
TWO_RUNS = ["--runs", "alone", "twin"]
WHERE = ["within", "before"]
"""Whether the first of two commands waits with the lock, or just before it takes it, until the second has ended."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patched:
        folder = tmp_path_factory.mktemp("cache")
        patched.setenv("MIEN_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def studio(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Studio:
    """Return a workspace with a run that was trained and evaluated alone."""
    made = toy_studio(tmp_path_factory.mktemp("studio") / "it", cache)
    assert main(["create", str(made.video), "--out", str(made.root), "--run", "alone", *made.create_options]) == 0
    folder = ["--out", str(made.avatar_folder), "--format", "gaussian-avatars"]
    assert main(["export", str(made.root), "--run", "alone", *folder]) == 0
    return made


@contextmanager
def twin_run(studio: Studio) -> Iterator[None]:
    """Let the workspace have a second run, which a study needs."""
    runs = studio.root / "runs"
    shutil.copytree(runs / "alone", runs / "twin")
    try:
        yield
    finally:
        shutil.rmtree(runs / "twin")


def commands_that_write(studio: Studio, folder: Path) -> dict[str, tuple[Path, list[str]]]:
    """Return commands by name, each with the place that it writes."""
    root, video, runs = studio.root, str(studio.video), studio.root / "runs"
    clip = studio.root / "sequences" / "clip"
    return {
        "capture": (
            clip,
            ["capture", video, "--out", str(root), "--name", "clip", *studio.capture_options, "--capture.end", "9"],
        ),
        "track": (clip, ["track", str(root), "--face-model", "toy", "--again"]),
        "align": (clip, ["align", str(root), "--split", "tail"]),
        "train": (runs / "new", ["train", str(root), "--run", "new", "--steps", "3"]),
        "create": (runs / "new", ["create", video, "--out", str(root), "--run", "new", *studio.create_options]),
        "evaluate": (runs / "alone", ["evaluate", str(root), "--run", "alone"]),
        "analyze": (
            root / "analysis" / "alone",
            ["analyze", "gaussian-avatars", str(root), "--run", "alone", "--parts", "growth"],
        ),
        "import": (runs / "new", ["import", str(studio.avatar_folder), "--out", str(root), "--run", "new"]),
        "demo": (folder / "demo" / "synthetic-0-1s.mp4", ["demo", "--out", str(folder / "demo"), "--seconds", "1"]),
        "bench quality": (folder / "q" / "quality", ["bench", "quality", "--out", str(folder / "q")]),
        "bench compare": (folder / "q" / "compare", ["bench", "compare", str(root), "--out", str(folder / "q")]),
        "study": (folder / "a.html", ["study", "make", str(root), "--out", str(folder / "a.html"), *TWO_RUNS]),
        "face-models": (
            Path(os.environ["MIEN_CACHE"]) / "face_models" / "added" / "pixels",
            ["face-models", "--add", f"{video}/0.png", "--name", "pixels"],
        ),
    }


def test_every_command_that_writes_tells_who_is_at_it(
    other: Holder, studio: Studio, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = commands_that_write(studio, tmp_path)
    with twin_run(studio), other.holding(*{place for place, _ in commands.values()}):
        before = tree_bytes(studio.root)
        for name, (place, command) in commands.items():
            assert main(command) == 2, name
            (line,) = capsys.readouterr().err.splitlines()  # and no progress bar before it
            assert line.startswith(f"mien: {place}: is being written by another command (process {other.pid} on "), name
            assert ("--run NAME" in line) == (name in ("train", "create", "import"))
            assert ("--out DIR" in line) == name.startswith("bench")
        changed = {name for name, content in tree_bytes(studio.root).items() if before.get(name) != content}
        assert all(name.endswith(".lock") for name in changed)


def test_readers_go_on_beside_every_lock(
    other: Holder, studio: Studio, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, run = str(studio.root), ["--run", "alone"]
    with other.holding(studio.root / "sequences" / "clip", studio.root / "runs" / "alone"):
        for command in (
            ["render", root, *run, "--out", str(tmp_path / "a.png"), "--size", "32"],
            ["drive", root, *run, "--by", root, "--out", str(tmp_path / "drive"), "--size", "32"],
            ["export", root, *run, "--out", str(tmp_path / "a.ply")],
            ["export", root, *run, "--out", str(tmp_path / "folder"), "--format", "gaussian-avatars"],
            ["import", str(tmp_path / "folder"), "--out", root, "--run", f"imported-{tmp_path.name}"],
            ["analyze", "gaussian-avatars", root, *run, "--parts", "growth", "--out", str(tmp_path / "analysis")],
            ["evaluate", root, *run, "--compare", "--out", str(tmp_path / "a.html")],
            ["capture", str(studio.video), "--out", root, "--name", "clip", *studio.capture_options],
            ["track", root, "--face-model", "toy", "--overlay", "none"],
            ["train", root, *run, "--steps", "3", "--split", "tail", *RANK],
            ["create", str(studio.video), "--out", root, *run, *studio.create_options],
        ):
            assert main(command) == 0, (command, capsys.readouterr().err)


def test_a_run_that_is_being_trained_cannot_be_rendered_yet(
    other: Holder, studio: Studio, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = studio.root / "runs" / "begun"
    run.mkdir()
    shutil.copy(studio.root / "runs" / "alone" / "config.json", run)
    render = ["render", str(studio.root), "--run", "begun", "--out", str(tmp_path / "a.png")]
    try:
        with other.holding(run):
            assert main(render) == 2
            line = capsys.readouterr().err
            assert f"process {other.pid} on" in line
            assert line.endswith("; try again when it is done\n")
        assert main(render) == 2
        assert "its training was not finished; run the same `mien train`" in capsys.readouterr().err
    finally:
        shutil.rmtree(run)


def test_a_workspace_whose_first_capture_is_at_work(
    other: Holder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "w" / "sequences" / "clip" / ".capture.partial").mkdir(parents=True)
    with other.holding(tmp_path / "w" / "sequences" / "clip"):
        assert main(["track", str(tmp_path / "w")]) == 2
    assert f"clip: is being written by another command (process {other.pid} on" in capsys.readouterr().err


def test_the_command_after_a_kill_goes_on_at_once(
    mortal: Holder, studio: Studio, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", str(studio.root), "--run", "killed", "--steps", "3", "--split", "tail", *RANK]
    with mortal.holding(studio.root / "runs" / "killed"):
        assert main(train) == 2
        mortal.kill()
        assert main(train) == 0
    assert_same_run(studio, "killed")


def assert_same_run(studio: Studio, name: str) -> None:
    """Check that the run has the bytes of the one that was trained alone."""
    alone, run = studio.root / "runs" / "alone", studio.root / "runs" / name
    for file in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (run / file).read_bytes() == (alone / file).read_bytes(), f"{name}: {file} differs"
    assert not [path for path in run.rglob(".*")], "something unfinished stays"
    assert not lock_file(run).exists()


def assert_told(pid: int, name: str, told: CompletedProcess[str]) -> None:
    """Check that a command was refused, since a process writes a place, and did nothing."""
    assert told.returncode == 2, told
    assert f"{name}: is being written by another command (process {pid} on " in told.stderr.splitlines()[-1]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kind", ["train", "capture", "import", "analyze"])
def test_one_of_two_works_and_the_other_names_it_or_finds_all_done(
    kind: str, where: str, studio: Studio, fork_server: ForkServer, tmp_path: Path
) -> None:
    """What is left is that of a single command."""
    root, out = str(studio.root), tmp_path / "out"
    of_capture = ["--out", str(out), "--name", "clip", *studio.capture_options]
    of_analysis = ["--run", "alone", "--parts", "growth", "--out", str(out)]
    words, place, work = {
        "train": (["train", root, "--run", where, "--steps", "3", "--split", "tail", *RANK], where, "training: 3/3"),
        "capture": (["capture", str(studio.video), *of_capture], "clip", "find the face in pictures: 5/5"),
        "import": (["import", str(studio.avatar_folder), "--out", str(out)], "gaussian_avatars", "Gaussians on toy"),
        "analyze": (["analyze", "gaussian-avatars", root, *of_analysis], "out", "Look at"),
    }[kind]
    pid, first, second = beside(fork_server, tmp_path / "wait", (where, place), words, words)
    if where == "within":
        assert first.returncode == 0, first.stderr
        assert_told(pid, place, second)
    else:
        assert (first.returncode, second.returncode) == (2 if kind == "import" else 0, 0), first.stderr + second.stderr
        late = {"import": "is there already; give the imported run another name", "analyze": "growth: measured before"}
        assert late.get(kind, "") in first.stderr
    worked = [work in each.stderr for each in (first, second)]
    assert worked == [where == "within" or kind == "analyze", where == "before"]
    if kind == "train":
        assert "training continues" not in first.stderr + second.stderr
        assert_same_run(studio, where)
    elif kind == "capture":
        expected = tree_bytes(studio.root / "sequences" / "clip" / "capture")
        assert tree_bytes(out / "sequences") == {f"clip/capture/{name}": data for name, data in expected.items()}
    elif kind == "import":
        files = tree_bytes(out / "runs" / "gaussian_avatars")
        assert {"avatar/avatar.safetensors", "config.json", "face_track.safetensors"} <= files.keys()
    else:
        assert json.loads((out / "analysis.json").read_text())["parts"].keys() == {"growth"}
        assert (out / "analysis.html").is_file()
    assert not lock_file(out).exists()


def figures_of_both(run: Path) -> dict[str, Any]:
    """The figures that both commands compute. `create` judges the avatar alone by ST-LPIPS."""
    content = json.loads((run / "metrics.json").read_text())["protocols"]["self_reenactment_tail"]
    others = {name: without_perceptual(content[name]) for name in ("as_tracked", "baselines")}
    return {key: value for key, value in content.items() if key != "seconds_per_frame"} | others


def without_perceptual(content: Any) -> Any:
    """The content without ST-LPIPS, at any depth."""
    if not isinstance(content, dict):
        return content
    return {key: without_perceptual(value) for key, value in content.items() if key != "perceptual"}


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    ("first_is", "trained"),
    [("create", True), ("evaluate", True), ("create", False)],
    ids=["create", "evaluate", "new"],
)
def test_create_beside_evaluate(
    first_is: str, trained: bool, where: str, studio: Studio, fork_server: ForkServer, tmp_path: Path
) -> None:
    """`create` beside `evaluate` works on a finished run without figures, and on a run that has to be trained first."""
    name, runs = f"{first_is}-{where}-{trained}", studio.root / "runs"
    shutil.copytree(runs / "alone", runs / name, ignore=shutil.ignore_patterns("metrics.json", "report.html", "videos"))
    if not trained:
        (runs / name / "training.json").unlink()
    create = ["create", str(studio.video), "--out", str(studio.root), "--run", name, *studio.create_options]
    lines = [create, ["evaluate", str(studio.root), "--run", name]]
    if first_is == "evaluate":
        lines.reverse()
    pid, first, second = beside(fork_server, tmp_path / "wait", (where, name), *lines)
    assert first.returncode == 0, first.stderr
    if where == "within":
        assert_told(pid, name, second)
    elif trained:
        assert second.returncode == 0, second.stderr
    else:
        assert "its training was not finished" in second.stderr
    assert_same_run(studio, name)
    assert figures_of_both(runs / name) == figures_of_both(runs / "alone")
