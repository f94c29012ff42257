"""Two commands on one workspace: locks, what is told, and real processes that start at the same moment."""

import errno
import fcntl
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_helpers import assert_same_capture, random_capture, tree_bytes
from mien import locks
from mien.capture import read_capture, write_capture
from mien.cli import main
from mien.errors import CannotWriteError, UserError
from mien.files import replace_folder
from mien.locks import BeingWrittenError, check_free, hold, holder_of, lock_file, read_beside_writers, read_holder
from mien.tracking import read_tracking, write_tracking
from mien.tracking.files import _TENSORS
from toy_scene import toy_face_model, toy_tracking
from two_commands import Outcome, Pair, Studio, pair, toy_studio

ROUNDS = 30
HOLDER = """
import json, sys
from pathlib import Path
from mien.locks import hold
for line in sys.stdin:
    with hold(*map(Path, json.loads(line))):
        print("held", flush=True)
        sys.stdin.readline()
    print("free", flush=True)
"""


class Holder:
    """Another process that holds what it is told to."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", HOLDER, "--an-option"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.pid = self.process.pid

    @contextmanager
    def holding(self, *places: Path) -> Iterator[None]:
        self._ask(json.dumps([str(place) for place in places]), "held")
        try:
            yield
        finally:
            if self.process.poll() is None:
                self._ask("", "free")

    def _ask(self, line: str, answer: str) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(line, file=self.process.stdin, flush=True)
        assert self.process.stdout.readline() == f"{answer}\n"

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def other() -> Iterator[Holder]:
    holder = Holder()
    yield holder
    holder.kill()


@pytest.fixture
def mortal() -> Iterator[Holder]:
    """For a test that kills it."""
    holder = Holder()
    yield holder
    holder.kill()


# The lock itself.


def test_one_holds_and_the_other_is_told(other: Holder, tmp_path: Path) -> None:
    place = tmp_path / "runs" / "r"
    with other.holding(place), pytest.raises(BeingWrittenError) as told, hold(place):
        pass
    words = str(told.value)
    assert words.startswith(f"{place}: is being written by another command (process {other.pid} on ")
    for part in (socket.gethostname(), ": -c --an-option)", " UTC", "wait until it is done, or end it"):
        assert part in words
    with hold(place), pytest.raises(BeingWrittenError, match=f"process {os.getpid()} on"), hold(place):
        pass


def test_nothing_stays_of_a_lock(tmp_path: Path) -> None:
    with hold(tmp_path / "new" / "deep" / "r"):
        assert (tmp_path / "new" / "deep" / ".r.lock").is_file()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError), hold(tmp_path / "a", tmp_path / "b"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    with hold(tmp_path / "new" / "r"):
        (tmp_path / "new" / "r").write_text("what was written")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["r"]


def test_several_places_are_held_all_or_none(other: Holder, tmp_path: Path) -> None:
    with other.holding(tmp_path / "b"):
        with pytest.raises(BeingWrittenError, match="b: is being written"), hold(tmp_path / "b", tmp_path / "a"):
            pass
        with hold(tmp_path / "a"):
            pass


def test_long_names_have_locks_of_their_own(tmp_path: Path) -> None:
    one, other = (tmp_path / ("n" * 250 + end) for end in "12")
    with hold(one), hold(other):
        assert len({lock_file(one), lock_file(other)}) == 2


def test_the_lock_of_a_killed_process_is_free_at_once(mortal: Holder, tmp_path: Path) -> None:
    place = tmp_path / "r"
    with mortal.holding(place):
        mortal.kill()
        assert lock_file(place).is_file()
        assert holder_of(place) is None
        with hold(place):
            assert json.loads(lock_file(place).read_text())["pid"] == os.getpid()
    assert not lock_file(place).exists()


def test_children_do_not_keep_the_lock_of_a_parent_that_has_died(tmp_path: Path) -> None:
    """Neither one made by fork, nor a program that was started, nor the end of a forked child's own context."""
    script = """
import os, subprocess, sys, time
from pathlib import Path
from mien.locks import hold
place = Path(sys.argv[1])
with hold(place):
    ended = os.fork()
    if ended == 0:
        sys.exit()  # through the end of the context
    os.waitpid(ended, 0)
    assert (place.parent / ".r.lock").is_file(), "a child removed it"
    forked = os.fork()
    if forked == 0:
        time.sleep(60)
    started = subprocess.Popen(["sleep", "60"])
    print(forked, started.pid, flush=True)
    sys.stdin.read()
"""
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "r")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        children = [int(word) for word in process.stdout.readline().split()]
        try:
            assert len(children) == 2
            with pytest.raises(BeingWrittenError), hold(tmp_path / "r"):
                pass
            process.kill()
            process.wait()
            with hold(tmp_path / "r"):
                pass
            for child in children:
                os.kill(child, 0)  # both live on
        finally:
            for child in children:
                os.kill(child, signal.SIGKILL)


@pytest.mark.parametrize("kind", ["link", "link to nowhere", "pipe", "second name", "other content", "folder"])
def test_a_strangers_lock_file_does_no_harm(kind: str, tmp_path: Path) -> None:
    mine, place = tmp_path / "mine", tmp_path / "w" / "r"
    mine.write_text("mine")
    file = lock_file(place)
    file.parent.mkdir()
    if kind == "link":
        file.symlink_to(mine)
    elif kind == "link to nowhere":
        file.symlink_to(tmp_path / "nowhere")
    elif kind == "pipe":
        os.mkfifo(file)
    elif kind == "second name":
        file.hardlink_to(mine)
    elif kind == "other content":
        mine.rename(file)
        mine = file
    else:
        file.mkdir()
    with pytest.raises(UserError, match="lock file"), hold(place):
        pass
    assert holder_of(place) is None
    assert mine.read_text() == "mine"
    assert not (tmp_path / "nowhere").exists()
    assert os.path.lexists(file)


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"pid": 7, "host": "h\x1b[31m", "since": "\u202e" * 90, "command": "mien\n\rtrain" + "x" * 3000}),
        json.dumps({"pid": 7, "host": [["h"] * 50], "since": {"a": 1}, "command": None}),
        json.dumps({"pid": 1 << 40, "host": "h"}),
        "[" * 4000,
        "",
        "\x00" * 5000,
    ],
)
def test_what_a_holder_says_is_not_trusted(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "_PATIENCE_SECONDS", 0.05)
    file = lock_file(tmp_path / "r")
    file.write_text(text, encoding="utf-8")
    with file.open() as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(BeingWrittenError) as told, hold(tmp_path / "r"):
            pass
        words = str(told.value).removeprefix(str(tmp_path))
        assert words.isprintable()
        assert len(words) < 500
        assert ("process 7 on " in words) == text.startswith('{"pid": 7')
        assert file.read_text(encoding="utf-8") == text


def test_the_name_of_a_dead_process_is_not_told(
    mortal: Holder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new holder that has not signed yet leaves the name of the one that was killed for a moment."""
    monkeypatch.setattr(locks, "_PATIENCE_SECONDS", 0.05)
    with mortal.holding(tmp_path / "r"):
        mortal.kill()
    with lock_file(tmp_path / "r").open() as handle:
        assert read_holder(handle.fileno()) is None
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(BeingWrittenError, match="has not left its name"):
            check_free(tmp_path / "r")


def test_a_file_system_without_locks_is_warned_of_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refused)
    monkeypatch.setattr(locks, "_once", {"fork"})
    for _ in range(2):
        with hold(tmp_path / "r"):
            assert holder_of(tmp_path / "r") is None
    assert capsys.readouterr().err.count("has no locks") == 1


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_place_that_cannot_be_written(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = os.open
    lock_file(tmp_path / "theirs").touch()  # another user's, left by a kill

    def read_only(path: Any, flags: int, *rest: Any) -> int:
        if flags & (os.O_CREAT | os.O_RDWR):
            raise OSError(number, os.strerror(number), str(path))
        return original(path, flags, *rest)

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(CannotWriteError, match="cannot be written"), hold(tmp_path / "r"):
        pass
    assert holder_of(tmp_path / "r") is None
    if number == errno.EACCES:
        with hold(tmp_path / "theirs"), pytest.raises(BeingWrittenError), hold(tmp_path / "theirs"):
            pass


def test_a_lock_whose_file_was_removed_is_not_taken_for_the_new_one(tmp_path: Path) -> None:
    """Threads that take and release one lock all the time are never inside together."""
    inside, most = [0], [0]

    def visit() -> None:
        visits = 0
        while visits < 60:
            try:
                with hold(tmp_path / "r"):
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    visits += 1
                    time.sleep(0)
                    inside[0] -= 1
            except BeingWrittenError:
                time.sleep(0.001)

    threads = [threading.Thread(target=visit) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert list(tmp_path.iterdir()) == []


# Readers.


def test_a_reader_of_damage_asks_who_writes(other: Holder, tmp_path: Path) -> None:
    calls: list[int] = []

    def damaged() -> None:
        calls.append(len(calls))
        raise UserError("damaged; make it again")

    def read() -> None:
        read_beside_writers(damaged, [tmp_path], [tmp_path / "r"])

    with pytest.raises(UserError, match="^damaged; make it again$"):
        read()
    assert len(calls) == 1, "nobody writes, so it is not read again"
    with hold(tmp_path / "r"), pytest.raises(UserError, match="^damaged"):  # this very command
        read()
    with other.holding(tmp_path / "r"):
        with pytest.raises(BeingWrittenError, match=rf"process {other.pid} .*; try again when it is done$"):
            read()
        assert len(calls) == 2 + 5, "readers look again a few times, and do not wait"


def test_a_reader_reads_again_what_was_replaced_meanwhile(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    file.write_text("0")

    def read() -> str:
        before = file.read_text()
        if before == "0":
            file.with_name("b").write_text("1")
            file.with_name("b").replace(file)  # as a writer would
            raise UserError("does not fit")
        return before

    assert read_beside_writers(read, [tmp_path], [tmp_path / "r"]) == "1"


def test_a_tracking_that_is_half_replaced(other: Holder, tmp_path: Path) -> None:
    model = toy_face_model()
    folder, new = tmp_path / "sequences" / "clip" / "tracking", tmp_path / "new"
    write_tracking(folder, toy_tracking(model, 4, 32))
    write_tracking(new, toy_tracking(model, 5, 32))
    with other.holding(folder.parent):
        assert len(read_tracking(folder).valid) == 4
        shutil.copy(new / _TENSORS, folder)
        with pytest.raises(BeingWrittenError, match=f"clip: is being written .*process {other.pid}"):
            read_tracking(folder)
        shutil.copy(new / "tracking.json", folder)
        assert len(read_tracking(folder).valid) == 5


def test_readers_beside_writers_see_the_old_or_the_new(tmp_path: Path) -> None:
    path, captures = tmp_path / "capture", [random_capture(timesteps=2 + index, seed=index) for index in range(2)]
    write_capture(path, captures[0])
    stop, failed, seen = threading.Event(), [], set()

    def rewrite() -> None:
        try:
            for index in range(1, 1000):
                if stop.is_set():
                    break
                write_capture(path, captures[index % 2])
        except BaseException as error:
            failed.append(error)

    writer = threading.Thread(target=rewrite)
    writer.start()
    try:
        for _ in range(150):
            found = read_capture(path)
            seen.add(found.timesteps)
            assert_same_capture(found, captures[found.timesteps - 2])
    finally:
        stop.set()
        writer.join()
    assert not failed
    assert seen == {2, 3}


def test_replaced_folders_are_never_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def folder(name: str, content: str) -> Path:
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(content)
        return tmp_path / name

    place = folder("place", "0")
    seen: list[bool] = []
    original = Path.rename
    monkeypatch.setattr(Path, "rename", lambda self, to: (seen.append(place.exists()), original(self, to))[1])
    replace_folder(place, folder("new", "1"))
    assert ((place / "file").read_text(), seen) == ("1", []), "exchanged, not renamed"
    monkeypatch.setattr("mien.files._exchange", lambda *_: False)
    replace_folder(place, folder("new", "2"))
    assert (place / "file").read_text() == "2"
    replace_folder(tmp_path / "other", folder("new", "3"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "place"]


def test_a_cache_that_another_reader_makes_is_made_elsewhere(other: Holder, tmp_path: Path) -> None:
    path, capture = tmp_path / "capture", random_capture()
    write_capture(path, capture)
    (path / "cache" / "stamp.json").unlink()
    (path / "cache" / ".making-left").mkdir()  # by a process that was killed
    mapped = np.memmap(path / "cache" / "frames.u8", np.uint8, "r")
    before = mapped.copy()
    with other.holding(path / "cache" / "frames.u8"):
        assert_same_capture(read_capture(path), capture)
        assert not (path / "cache" / "stamp.json").exists()
    (path / "cache" / "frames.u8").write_bytes(b"\0" * len(before))  # damaged, and mapped by a reader
    assert_same_capture(read_capture(path), capture)
    assert (mapped == 0).all(), "the file under a reader's map stays as it was"
    assert sorted(entry.name for entry in (path / "cache").iterdir()) == ["frames.u8", "mattes.u8", "stamp.json"]


# Commands.


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patched:
        folder = tmp_path_factory.mktemp("cache")
        patched.setenv("MIEN_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def studio(cache: Path, both: Pair, tmp_path_factory: pytest.TempPathFactory) -> Studio:
    """Captured, tracked, with a run that was trained and evaluated without anybody beside."""
    made = toy_studio(tmp_path_factory.mktemp("studio") / "it", cache)
    assert main(["create", str(made.video), "--out", str(made.root), "--run", "alone", *made.look]) == 0
    return made


@pytest.fixture(scope="module")
def both(cache: Path) -> Iterator[Pair]:
    """Begun before anything else, since they import for some seconds."""
    with pair(cache) as processes:
        yield processes


def commands_that_write(studio: Studio, folder: Path) -> dict[str, tuple[Path, list[str]]]:
    """Place that a command writes, and the command."""
    root, video, runs = studio.root, str(studio.video), studio.root / "runs"
    clip = studio.root / "sequences" / "clip"
    return {
        "capture": (
            clip,
            ["capture", video, "--out", str(root), "--name", "clip", *studio.given, "--capture.end", "9"],
        ),
        "track": (clip, ["track", str(root), "--face-model", "toy", "--again"]),
        "train": (runs / "new", ["train", str(root), "--run", "new", "--steps", "3"]),
        "create": (runs / "new", ["create", video, "--out", str(root), "--run", "new", *studio.look]),
        "evaluate": (runs / "alone", ["evaluate", str(root), "--run", "alone"]),
        "demo": (folder / "demo" / "synthetic-0-1s.mp4", ["demo", "--out", str(folder / "demo"), "--seconds", "1"]),
        "bench quality": (folder / "q" / "quality", ["bench", "quality", "--out", str(folder / "q")]),
        "face-models": (
            Path(os.environ["MIEN_CACHE"]) / "face_models" / "added" / "pixels",
            ["face-models", "--add", f"{video}/0.png", "--name", "pixels"],
        ),
    }


def test_every_command_that_writes_tells_who_is_at_it(
    other: Holder, studio: Studio, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = commands_that_write(studio, tmp_path)
    before = tree_bytes(studio.root)
    with other.holding(*{place for place, _ in commands.values()}):
        for name, (place, command) in commands.items():
            assert main(command) == 2, name
            (line,) = capsys.readouterr().err.splitlines()  # and no bar of progress before it
            assert line.startswith(f"mien: {place}: is being written by another command (process {other.pid} on "), name
            assert ("--run NAME" in line) == (name in ("train", "create"))
            assert ("--out DIR" in line) == (name == "bench quality")
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
            ["evaluate", root, *run, "--compare", "--out", str(tmp_path / "a.html")],
            ["capture", str(studio.video), "--out", root, "--name", "clip", *studio.given],
            ["track", root, "--face-model", "toy", "--overlay", "none"],
            ["train", root, *run, "--steps", "3", "--split", "tail"],
            ["create", str(studio.video), "--out", root, *run, *studio.look],
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
        assert "holds no trained avatar" in capsys.readouterr().err
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
    train = ["train", str(studio.root), "--run", "killed", "--steps", "3", "--split", "tail"]
    with mortal.holding(studio.root / "runs" / "killed"):
        assert main(train) == 2
        mortal.kill()
        assert main(train) == 0
    assert_same_run(studio, "killed")


# Real processes, at the same moment.


def assert_same_run(studio: Studio, name: str) -> None:
    """The run has the bytes of the one that was trained alone."""
    alone, run = studio.root / "runs" / "alone", studio.root / "runs" / name
    for file in ("avatar/avatar.safetensors", "avatar/avatar.json", "face_track.safetensors"):
        assert (run / file).read_bytes() == (alone / file).read_bytes(), f"{name}: {file} differs"
    assert not [path for path in run.rglob(".*")], "something unfinished stays"
    assert not lock_file(run).exists()


def assert_apart(outcomes: list[Outcome], name: str) -> bool:
    """Nobody worked while the other did; who was told was told whom to wait for. Whether somebody was."""
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


def test_two_trainings_of_one_run(studio: Studio, both: Pair) -> None:
    told = 0
    for index in range(ROUNDS):
        command = ["train", str(studio.root), "--run", f"t{index}", "--steps", "3", "--split", "tail"]
        outcomes = both.run(command, command)
        told += assert_apart(outcomes, f"t{index}")
        assert sum(len(one.worked) for one in outcomes) == 1, "trained once"
        assert_same_run(studio, f"t{index}")
    assert told > ROUNDS / 4, "they hardly met"


def test_two_captures_of_one_video(studio: Studio, both: Pair, tmp_path: Path) -> None:
    expected = tree_bytes(studio.root / "sequences" / "clip" / "capture")
    told = 0
    for index in range(ROUNDS):
        root = tmp_path / str(index)
        command = ["capture", str(studio.video), "--out", str(root), "--name", "clip", *studio.given]
        outcomes = both.run(command, command)
        told += assert_apart(outcomes, "clip")
        assert sum(len(one.worked) for one in outcomes) == 1, "captured once"
        assert tree_bytes(root / "sequences") == {f"clip/capture/{name}": data for name, data in expected.items()}
    assert told > ROUNDS / 4, "they hardly met"


def test_create_beside_evaluate(studio: Studio, both: Pair) -> None:
    """On a finished run without figures; every third round on one that `create` has to train first."""
    runs, told, figures = studio.root / "runs", 0, []
    for index in range(ROUNDS):
        name, run = f"e{index}", runs / f"e{index}"
        shutil.copytree(runs / "alone", run, ignore=shutil.ignore_patterns("metrics.json", "report.html", "videos"))
        if index % 3 == 2:
            (run / "training.json").unlink()
        create = ["create", str(studio.video), "--out", str(studio.root), "--run", name, *studio.look]
        outcomes = both.run(create, ["evaluate", str(studio.root), "--run", name])
        if "missing; run `mien train` again" in outcomes[1].told:  # it came first, and there was nothing to evaluate
            assert outcomes[0].code == 0
        else:
            told += assert_apart(outcomes, name)
        assert_same_run(studio, name)
        content = json.loads((run / "metrics.json").read_text())["protocols"]["self_reenactment_tail"]
        figures.append({key: value for key, value in content.items() if key != "seconds_per_frame"})
        shutil.rmtree(run)
    assert all(one == figures[0] for one in figures)
    assert told > ROUNDS / 4, "they hardly met"
