"""Readers beside writers see the old or the new files, never a mixture, and name the writer if they cannot read."""

import ctypes
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from capture_helpers import assert_same_capture, random_capture
from mien.capture import read_capture, write_capture
from mien.errors import UserError
from mien.files import replace_folder
from mien.locks import BeingWrittenError, hold, read_beside_writers
from mien.tracking import read_tracking, write_tracking
from other_process import Holder
from toy_scene import toy_face_model, toy_tracking


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
        shutil.copy(new / "tracking.safetensors", folder)
        with pytest.raises(BeingWrittenError, match=f"clip: is being written .*process {other.pid}"):
            read_tracking(folder)
        shutil.copy(new / "tracking.json", folder)
        assert len(read_tracking(folder).valid) == 5


def test_readers_beside_writers_see_the_old_or_the_new(tmp_path: Path) -> None:
    path, captures = tmp_path / "capture", [random_capture(timesteps=2 + index, seed=index) for index in range(2)]
    write_capture(path, captures[0])
    stop, was_read, failed, seen = threading.Event(), threading.Event(), [], set()

    def rewrite() -> None:
        try:
            while not stop.is_set():
                write_capture(path, captures[len(written) % 2])
                written.append(1)
                was_read.wait()  # so that no reader meets writers five times in a row, however slow it is
                was_read.clear()
        except BaseException as error:
            failed.append(error)

    written = [1]
    writer = threading.Thread(target=rewrite)
    writer.start()
    try:
        while len(written) < 30 and not failed:
            found = read_capture(path)
            was_read.set()
            seen.add(found.timesteps)
            assert_same_capture(found, captures[found.timesteps - 2])
    finally:
        stop.set()
        was_read.set()
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
