"""A lock is held by one process at a time, names its holder to others, and leaves nothing behind."""

import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mien import locks
from mien.errors import CannotWriteError, UserError
from mien.locks import BeingWrittenError, check_free, hold, holder_of, lock_file, read_holder
from other_process import Holder


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
    one, other = (tmp_path / ("n" * 250 + end) for end in "12")
    with hold(one), hold(other):
        assert lock_file(one) != lock_file(other), "long names have locks of their own"


def test_several_places_are_held_all_or_none(other: Holder, tmp_path: Path) -> None:
    with other.holding(tmp_path / "b"):
        with pytest.raises(BeingWrittenError, match="b: is being written"), hold(tmp_path / "b", tmp_path / "a"):
            pass
        with hold(tmp_path / "a"):
            pass


def test_the_lock_of_a_killed_process_is_free_at_once(mortal: Holder, tmp_path: Path, monkeypatch) -> None:
    """Its name is not told: a new holder that has not signed yet leaves the old name for a moment."""
    monkeypatch.setattr(locks, "PATIENCE_SECONDS", 0.05)
    place = tmp_path / "r"
    with mortal.holding(place):
        mortal.kill()
    assert holder_of(place) is None
    with lock_file(place).open() as handle:
        assert read_holder(handle.fileno()) is None
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(BeingWrittenError, match="has not left its name"):
            check_free(place)
    with hold(place):
        assert json.loads(lock_file(place).read_text())["pid"] == os.getpid()
    assert not lock_file(place).exists()


def test_children_do_not_keep_the_lock_of_a_parent_that_has_died(tmp_path: Path) -> None:
    """No fork, no started program, no fork's own context keeps it."""
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
    words = [sys.executable, "-c", script, str(tmp_path / "r")]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
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


STRANGERS: dict[str, Callable[[Path, Path], object]] = {
    "link": lambda file, mine: file.symlink_to(mine),
    "link to nowhere": lambda file, mine: file.symlink_to(mine.with_name("nowhere")),
    "pipe": lambda file, mine: os.mkfifo(file),
    "second name": lambda file, mine: file.hardlink_to(mine),
    "other content": lambda file, mine: file.write_text("mine"),
    "folder": lambda file, mine: file.mkdir(),
}


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


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"pid": 7, "host": "h\x1b[31m", "since": "\u202e" * 90, "command": "mien\n\rtrain" + "x" * 3000}),
        json.dumps({"pid": 7, "host": [["h"] * 50], "since": {"a": 1}, "command": None}),
        json.dumps({"pid": 1 << 40, "host": "h"}),
        "[" * 4000,
        "\x00" * 5000,
    ],
)
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
    lock_file(tmp_path / "theirs").touch()  # left by another user's killed process

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
    """Threads that lock in turns never hold it together."""
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
