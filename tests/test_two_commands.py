"""One of two commands on a workspace works, and the other names it, even if both start at once."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from capture_helpers import tree_bytes
from mien.cli import main
from mien.locks import lock_file
from other_process import Holder
from two_commands import RANK, Outcome, Pair, Studio, pair, toy_studio, waits_to_meet

ROUNDS, MOST_ROUNDS = 12, 120
TWO_RUNS = ["--runs", "alone", "twin"]
MEETINGS = ROUNDS // 4  # a pair that meets less often goes on, up to ten times as many rounds


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patched:
        folder = tmp_path_factory.mktemp("cache")
        patched.setenv("MIEN_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def studio(cache: Path, both: Pair, tmp_path_factory: pytest.TempPathFactory) -> Studio:
    """Return a workspace with a run that was trained and evaluated alone."""
    made = toy_studio(tmp_path_factory.mktemp("studio") / "it", cache)
    assert main(["create", str(made.video), "--out", str(made.root), "--run", "alone", *made.create_options]) == 0
    folder = ["--out", str(made.avatar_folder), "--format", "gaussian-avatars"]
    assert main(["export", str(made.root), "--run", "alone", *folder]) == 0
    return made


@pytest.fixture(scope="module")
def both(cache: Path) -> Iterator[Pair]:
    """Start two processes before anything else, since their imports take some seconds."""
    with pair(cache) as processes:
        yield processes


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


# Real processes, at the same moment.


def assert_same_run(studio: Studio, name: str) -> None:
    """Check that the run has the bytes of the one that was trained alone."""
    alone, run = studio.root / "runs" / "alone", studio.root / "runs" / name
    for file in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (run / file).read_bytes() == (alone / file).read_bytes(), f"{name}: {file} differs"
    assert not [path for path in run.rglob(".*")], "something unfinished stays"
    assert not lock_file(run).exists()


def assert_apart(outcomes: list[Outcome], name: str) -> bool:
    """Check that only one command worked at a time, and that the other named it. Return whether one had to."""
    intervals = sorted((began, ended, what) for one in outcomes for what, began, ended in one.worked)
    for before, after in zip(intervals, intervals[1:], strict=False):
        assert before[1] <= after[0], f"{name}: {before[2]} and {after[2]} at once"
    for one, other in (outcomes, outcomes[::-1]):
        assert one.code in (0, 2), one
        if one.code == 2:
            line = one.told.splitlines()[-1]
            assert f"{name}: is being written by another command (process {other.pid} on " in line
            assert not one.worked
            assert other.code == 0, other
    return any(one.code == 2 for one in outcomes)


@pytest.mark.slow
def test_two_trainings_of_one_run(studio: Studio, both: Pair) -> None:
    """One of two trainings of a run works, and the run is that of a single training."""
    told = 0
    for index in range(MOST_ROUNDS):
        if index >= ROUNDS and told > MEETINGS:
            break
        command = ["train", str(studio.root), "--run", f"t{index}", "--steps", "3", "--split", "tail", *RANK]
        outcomes = both.run(command, command)
        told += assert_apart(outcomes, f"t{index}")
        assert sum(len(one.worked) for one in outcomes) == 1, "trained once"
        assert_same_run(studio, f"t{index}")
    assert told > MEETINGS, "they hardly met"


def test_two_captures_of_one_video(studio: Studio, both: Pair, tmp_path: Path) -> None:
    """One of two captures of a video works, and the result is that of a single one."""
    expected = tree_bytes(studio.root / "sequences" / "clip" / "capture")
    told = 0
    for index in range(MOST_ROUNDS):
        if index >= ROUNDS and told > MEETINGS:
            break
        root = tmp_path / str(index)
        command = ["capture", str(studio.video), "--out", str(root), "--name", "clip", *studio.capture_options]
        outcomes = both.run(command, command)
        told += assert_apart(outcomes, "clip")
        assert sum(len(one.worked) for one in outcomes) == 1, "captured once"
        assert tree_bytes(root / "sequences") == {f"clip/capture/{name}": data for name, data in expected.items()}
    assert told > MEETINGS, "they hardly met"


def test_two_imports_of_one_run(studio: Studio, both: Pair, tmp_path: Path) -> None:
    """One of two imports of a run works. The other one names it, or says that the run is there."""
    told = 0
    for index in range(MOST_ROUNDS):
        if index >= ROUNDS and told > MEETINGS:
            break
        out = tmp_path / str(index)
        command = ["import", str(studio.avatar_folder), "--out", str(out)]
        outcomes = sorted(both.run(command, command), key=lambda outcome: outcome.code)
        assert [outcome.code for outcome in outcomes] == [0, 2], outcomes
        assert [len(outcome.worked) for outcome in outcomes] == [1, 0], "imported once"
        line = outcomes[1].told.splitlines()[-1]
        busy = f"is being written by another command (process {outcomes[0].pid} on " in line
        assert busy or "is there already; give the imported run another name" in line
        told += busy
        files = tree_bytes(out / "runs" / "gaussian_avatars")
        assert {"avatar/avatar.safetensors", "config.json", "face_track.safetensors"} <= files.keys()
    assert told > 0, "they never met"


def test_two_analyses_of_one_run(studio: Studio, both: Pair, tmp_path: Path) -> None:
    """One of two analyses works at a time, and nothing is measured twice."""
    told = 0
    for index in range(MOST_ROUNDS // 2):
        if index >= ROUNDS // 2 and told > 0:
            break
        out = tmp_path / str(index)
        command = ["analyze", "gaussian-avatars", str(studio.root), "--run", "alone", "--parts", "growth"]
        outcomes = both.run([*command, "--out", str(out)], [*command, "--out", str(out)])
        told += assert_apart(outcomes, str(index))
        assert json.loads((out / "analysis.json").read_text())["parts"].keys() == {"growth"}
        assert (out / "analysis.html").is_file()
        assert not lock_file(out).exists()
    assert told > 0, "they never met"


def figures_of_both(content: dict[str, Any]) -> dict[str, Any]:
    """The figures of a protocol that both commands compute. `create` judges the avatar alone by ST-LPIPS."""
    others = {name: without_perceptual(content[name]) for name in ("as_tracked", "baselines")}
    return {key: value for key, value in content.items() if key != "seconds_per_frame"} | others


def without_perceptual(content: Any) -> Any:
    """The content without ST-LPIPS, at any depth."""
    if not isinstance(content, dict):
        return content
    return {key: without_perceptual(value) for key, value in content.items() if key != "perceptual"}


@pytest.mark.slow
def test_create_beside_evaluate(studio: Studio, both: Pair) -> None:
    """`create` beside `evaluate` works on a finished run without figures, and on a run that has to be trained first.

    Each needs its own time until it writes, so the quicker one waits by what the rounds before measured.
    """
    runs, told, figures = studio.root / "runs", 0, []
    waits: dict[bool, tuple[float, float]] = {True: (0, 0), False: (0, 0)}
    for index in range(MOST_ROUNDS):
        if index >= ROUNDS and told > MEETINGS:
            break
        name, run = f"e{index}", runs / f"e{index}"
        shutil.copytree(runs / "alone", run, ignore=shutil.ignore_patterns("metrics.json", "report.html", "videos"))
        trained = index % 3 != 2
        if not trained:
            (run / "training.json").unlink()
        create = ["create", str(studio.video), "--out", str(studio.root), "--run", name, *studio.create_options]
        outcomes = both.run(create, ["evaluate", str(studio.root), "--run", name], waits=waits[trained])
        if all(outcome.code == 0 for outcome in outcomes):
            waits[trained] = waits_to_meet(waits[trained], outcomes)
        if "its training was not finished" in outcomes[1].told:  # it came first, and there was nothing to evaluate
            assert outcomes[0].code == 0
        else:
            told += assert_apart(outcomes, name)
        assert_same_run(studio, name)
        content = json.loads((run / "metrics.json").read_text())["protocols"]["self_reenactment_tail"]
        figures.append(figures_of_both(content))
        shutil.rmtree(run)
    assert all(one == figures[0] for one in figures)
    assert told > MEETINGS, "they hardly met"
