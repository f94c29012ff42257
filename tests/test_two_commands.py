"""One of two commands on a workspace works, and the other names it, even if both start at once."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from capture_helpers import tree_bytes
from forked import Forked, ForkServer
from mien.cli import main
from mien.disk.locks import lock_file
from mien.pipeline.stage_times import FILE_NAME, StageTimes
from other_process import Holder
from refusals import complaint
from two_commands import RANK, Studio, beside, toy_studio

pytestmark = [pytest.mark.unchecked, pytest.mark.usefixtures("short_films")]
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


def test_create_keeps_what_each_stage_took(studio: Studio) -> None:
    times = StageTimes(studio.root / FILE_NAME)
    assert list(times.stages) == ["capture", "tracking", "alignment", "training", "scoring"]
    assert times.stages["training"].processor > 0


def commands_that_write(studio: Studio, folder: Path) -> list[tuple[Path, str]]:
    root, video, runs = studio.root, studio.video, studio.root / "runs"
    clip, cache = root / "sequences/clip", Path(os.environ["MIEN_CACHE"])
    capture, create = " ".join(studio.capture_options), " ".join(studio.create_options)
    return [
        (clip, f"capture {video} --out {root} --name clip {capture} --capture.end 9"),
        (clip, f"track {root} --face-model toy --again"),
        (clip, f"align {root} --split tail"),
        (runs / "new", f"train {root} --run new --steps 3"),
        (runs / "new", f"create {video} --out {root} --run new {create}"),
        (runs / "new", f"import {studio.avatar_folder} --out {root} --run new"),
        (runs / "alone", f"evaluate {root} --run alone"),
        (root / "analysis/alone", f"analyze gaussian-avatars {root} --run alone --parts growth"),
        (folder / "demo/synthetic-0-1s.mp4", f"demo --out {folder}/demo --seconds 1"),
        (folder / "q/quality", f"bench quality --out {folder}/q"),
        (folder / "q/compare", f"bench compare {root} --out {folder}/q"),
        (folder / "a.html", f"study make {root} --out {folder}/a.html --runs alone twin"),
        (cache / "face_models/added/pixels", f"face-models --add {video}/0.png --name pixels"),
    ]


def test_every_command_that_writes_tells_who_is_at_it(other: Holder, studio: Studio, tmp_path: Path, capsys) -> None:
    twin = shutil.copytree(studio.root / "runs/alone", studio.root / "runs/twin")  # a study needs two runs
    commands = commands_that_write(studio, tmp_path)
    with other.holding(*{place for place, _ in commands}):
        before = tree_bytes(studio.root)
        for place, words in commands:
            line = complaint(capsys, *words.split())  # and no progress bar before it
            told = f"mien: {place}: is being written by another command (process {other.pid} on "
            assert line.startswith(told), words
            assert ("--run NAME" in line) == words.startswith(("train", "create", "import"))
            assert ("--out DIR" in line) == words.startswith("bench")
        changed = {name for name, content in tree_bytes(studio.root).items() if before.get(name) != content}
        assert all(name.endswith(".lock") for name in changed)
    shutil.rmtree(twin)


def test_readers_go_on_beside_every_lock(other: Holder, studio: Studio, tmp_path: Path, capsys) -> None:
    root, out, create = studio.root, tmp_path, " ".join(studio.create_options)
    with other.holding(root / "sequences" / "clip", root / "runs" / "alone"):
        for words in (
            f"render {root} --run alone --out {out}/a.png --size 32",
            f"drive {root} --run alone --by {root} --out {out}/drive --size 32",
            f"export {root} --run alone --out {out}/a.ply",
            f"export {root} --run alone --out {out}/folder --format gaussian-avatars",
            f"import {out}/folder --out {root} --run imported-{out.name}",
            f"analyze gaussian-avatars {root} --run alone --parts growth --out {out}/analysis",
            f"evaluate compare {root} --run alone --out {out}/a.html",
            f"capture {studio.video} --out {root} --name clip {' '.join(studio.capture_options)}",
            f"track {root} --face-model toy --overlay none",
            f"train {root} --run alone --steps 3 --split tail {' '.join(RANK)}",
            f"create {studio.video} --out {root} --run alone {create}",
        ):
            assert main(words.split()) == 0, (words, capsys.readouterr().err)


def test_a_run_that_is_being_trained_cannot_be_rendered_yet(other: Holder, studio: Studio, tmp_path, capsys) -> None:
    run = studio.root / "runs" / "begun"
    run.mkdir()
    shutil.copy(studio.root / "runs" / "alone" / "config.json", run)
    render = ["render", str(studio.root), "--run", "begun", "--out", str(tmp_path / "a.png")]
    with other.holding(run):
        line = complaint(capsys, *render)
        assert f"process {other.pid} on" in line
        assert line.endswith("; try again when it is done")
    assert "its training was not finished; run the same `mien train`" in complaint(capsys, *render)
    shutil.rmtree(run)
    # A workspace whose first capture is at work.
    clip = tmp_path / "w" / "sequences" / "clip"
    (clip / ".capture.partial").mkdir(parents=True)
    with other.holding(clip):
        told = complaint(capsys, "track", tmp_path / "w")
    assert f"clip: is being written by another command (process {other.pid} on" in told


def assert_same_run(studio: Studio, name: str) -> None:
    """Check that the run has the bytes of the one that was trained alone."""
    alone, run = studio.root / "runs" / "alone", studio.root / "runs" / name
    for file in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (run / file).read_bytes() == (alone / file).read_bytes(), f"{name}: {file} differs"
    assert not [path for path in run.rglob(".*")], "something unfinished stays"
    assert not lock_file(run).exists()


def assert_told(first: Forked, name: str, told: Forked) -> None:
    """Check that a command was refused, since another one writes a place, and did nothing."""
    assert told.poll() == 2, told.stderr
    assert f"{name}: is being written by another command (process {first.pid} on " in told.stderr.splitlines()[-1]


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
    first, second = beside(fork_server, tmp_path / "wait", (where, place), words, words)
    if where == "within":
        assert first.poll() == 0, first.stderr
        assert_told(first, place, second)
    else:
        assert (first.poll(), second.poll()) == (2 if kind == "import" else 0, 0), first.stderr + second.stderr
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
