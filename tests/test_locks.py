"""A lock is held by one process at a time and names it; readers beside writers see the old or the new files."""

import ctypes
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
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_helpers import assert_same_capture, random_capture
from known import known
from mien.capture import read_capture, write_capture
from mien.disk import locks
from mien.disk.files import replace_folder
from mien.disk.locks import BeingWrittenError, hold, holder_of, lock_file, read_beside_writers
from mien.errors import CannotWriteError, UserError
from mien.tracking import read_tracking, write_tracking
from other_process import Holder
from toy_scene import toy_face_model, toy_tracking


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
    free = place.with_name("a")
    with other.holding(place), pytest.raises(BeingWrittenError, match="r: is being written"), hold(place, free):
        pass
    with hold(free):
        assert holder_of(place) is None, "several places are held all or none"


def test_nothing_stays_of_a_lock_and_a_removed_file_is_not_taken_for_the_new_one(tmp_path: Path) -> None:
    with hold(tmp_path / "new" / "deep" / "r"):
        assert (tmp_path / "new" / "deep" / ".r.lock").is_file()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError), hold(tmp_path / "a", tmp_path / "b"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    with hold(tmp_path / "new" / "r"):
        (tmp_path / "new" / "r").write_text("what was written")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["r"]
    one, other = (tmp_path / ("n" * 250 + end) for end in "12")
    with hold(one), hold(other):
        assert lock_file(one) != lock_file(other), "long names have locks of their own"
    # Threads that lock in turns never hold it together.
    inside, most = [0], [0]

    def visit(_: int) -> None:
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

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(visit, range(4)))
    assert (most[0], list(tmp_path.iterdir())) == (1, [tmp_path / "new"])


def test_children_do_not_keep_the_lock_of_a_parent_that_has_died(tmp_path: Path) -> None:
    """No fork, no started program, no fork's own context keeps it."""
    script = """
import os, subprocess, sys, time
from pathlib import Path
from mien.disk.locks import hold
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
    words = [sys.executable, "-c", script, str(tmp_path / "r")]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with process:
        children = [int(word) for word in known(process.stdout).readline().split()]
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


STRANGERS: dict[str, Callable[[Path, Path], object]] = {
    "link": lambda file, mine: file.symlink_to(mine),
    "link to nowhere": lambda file, mine: file.symlink_to(mine.with_name("nowhere")),
    "pipe": lambda file, mine: os.mkfifo(file), "second name": lambda file, mine: file.hardlink_to(mine),
    "other content": lambda file, mine: file.write_text("mine"), "folder": lambda file, mine: file.mkdir(),
}  # fmt: skip


@pytest.mark.parametrize("kind", STRANGERS)
def test_a_strangers_lock_file_does_no_harm(kind: str, tmp_path: Path) -> None:
    mine, place = tmp_path / "mine", tmp_path / "w" / "r"
    mine.write_text("mine")
    file = lock_file(place)
    file.parent.mkdir()
    STRANGERS[kind](file, mine)
    with pytest.raises(UserError, match="lock file"), hold(place):
        pass
    assert holder_of(place) is None
    assert mine.read_text() == "mine"
    assert not (tmp_path / "nowhere").exists()
    assert os.path.lexists(file)
    assert kind != "other content" or file.read_text() == "mine"


@pytest.mark.parametrize("text", [
    json.dumps({"pid": 7, "host": "h\x1b[31m", "since": "\u202e" * 90, "command": "mien\n\rtrain" + "x" * 3000}),
    json.dumps({"pid": 7, "host": [["h"] * 50], "since": {"a": 1}, "command": None}),
    json.dumps({"pid": 1 << 40, "host": "h"}),
    "[" * 4000,
    "\x00" * 5000,
])  # fmt: skip
def test_what_a_holder_says_is_not_trusted(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "PATIENCE_SECONDS", 0.05)
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


def test_a_file_system_without_locks_is_warned_of_once(tmp_path: Path, monkeypatch, capsys) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refused)
    monkeypatch.setattr(locks, "said_once", set())
    for _ in range(2):
        with hold(tmp_path / "r"):
            assert holder_of(tmp_path / "r") is None
    assert capsys.readouterr().err.count("has no locks") == 1


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_place_that_cannot_be_written(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = os.open

    def read_only(path: Any, flags: int, *rest: Any) -> int:
        if flags & (os.O_CREAT | os.O_RDWR):
            raise OSError(number, os.strerror(number), str(path))
        return original(path, flags, *rest)

    monkeypatch.setattr(os, "open", read_only)
    with pytest.raises(CannotWriteError, match="cannot be written"), hold(tmp_path / "r"):
        pass
    assert holder_of(tmp_path / "r") is None


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
    folder, new = tmp_path / "sequences" / "clip" / "tracking", tmp_path / "new"
    for place, timesteps in ((folder, 4), (new, 5)):
        write_tracking(place, toy_tracking(toy_face_model(), timesteps, 32))
    with other.holding(folder.parent):
        assert len(read_tracking(folder).valid) == 4
        shutil.copy(new / "tracking.safetensors", folder)
        with pytest.raises(BeingWrittenError, match=f"clip: is being written .*process {other.pid}"):
            read_tracking(folder)
        shutil.copy(new / "tracking.json", folder)
        assert len(read_tracking(folder).valid) == 5


def test_readers_beside_writers_see_the_old_or_the_new(tmp_path: Path) -> None:
    path, captures = tmp_path / "capture", [random_capture(timesteps=2 + index, seed=index) for index in range(2)]
    write_capture(path, captures[0])
    stop, was_read, written, seen = threading.Event(), threading.Event(), [1], set()

    def rewrite() -> None:
        while not stop.is_set():
            write_capture(path, captures[len(written) % 2])
            written.append(1)
            was_read.wait()  # so that no reader meets writers five times in a row, however slow it is
            was_read.clear()

    with ThreadPoolExecutor(1) as pool:
        writer = pool.submit(rewrite)
        try:
            while len(written) < 30 and not writer.done():
                found = read_capture(path)
                was_read.set()
                seen.add(found.timesteps)
                assert_same_capture(found, captures[found.timesteps - 2])
        finally:
            stop.set()
            was_read.set()
    writer.result()
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
    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())  # a system that cannot exchange two names
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
