"""A path that cannot be written is reported before any work; long names work; arrays are stored without torch."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mien.errors import UserError
from mien.files import check_writable, read_arrays, remove_leftovers, write_arrays, write_atomically
from needs import IS_ROOT


def test_writable_places_leave_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "there.png").write_bytes(b"old")
    check_writable(tmp_path / "there.png")
    check_writable(tmp_path / "new.png")
    check_writable(tmp_path / "a" / "b" / "new.png")
    check_writable(tmp_path, folder=True)
    check_writable(tmp_path / "a" / "new", folder=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["there.png"]
    assert (tmp_path / "there.png").read_bytes() == b"old"


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    os.mkfifo(tmp_path / "pipe")
    for path, folder, reason in (
        (tmp_path, False, "is a folder"),
        (tmp_path / "file", True, "is a file"),
        (tmp_path / "file" / "new.png", False, "is a file, not a folder|Not a directory"),
        (tmp_path / "file" / "a" / "new.png", False, "is a file, not a folder|Not a directory"),
        (tmp_path / "link" / "new.png", False, "link to nowhere"),
        (tmp_path / "pipe", False, "not an ordinary file"),
        (Path("/dev/null"), False, "not an ordinary file"),
        (Path("/proc/new.png"), False, "cannot be written"),
        (Path("/proc/new"), True, "cannot be written"),
        (tmp_path / ("x" * 300), False, "cannot be written"),
    ):
        with pytest.raises(UserError, match=reason):
            check_writable(path, folder=folder)


@pytest.mark.skipif(os.geteuid() == 0, reason=IS_ROOT)
def test_a_folder_without_permission(tmp_path: Path) -> None:
    """A folder without permission is refused before any work."""
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(UserError, match="Permission denied"):
            check_writable(tmp_path / "new.png")
    finally:
        tmp_path.chmod(0o700)


def test_names_as_long_as_a_file_system_allows(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 250 + ".bin")
    check_writable(path)
    write_atomically(path, lambda temporary: temporary.write_bytes(b"1"))
    assert path.read_bytes() == b"1"


def test_what_killed_writers_left_is_removed(tmp_path: Path) -> None:
    path, kept = tmp_path / "overlay.mp4", tmp_path / ".overlay.json"
    for name in (path, kept, tmp_path / ".overlay.mp4.a1b2c3.mp4", tmp_path / ".overlay.mp4.d4.mp4"):
        name.write_bytes(b"1")
    remove_leftovers(path)
    assert sorted(tmp_path.iterdir()) == sorted([path, kept])
    remove_leftovers(tmp_path / "missing" / "overlay.mp4")


def test_arrays_and_their_metadata_need_no_torch(tmp_path: Path) -> None:
    write_arrays(tmp_path / "a.safetensors", {"x": np.arange(3, dtype=np.float32)}, {"note": "hello"})
    assert read_arrays(tmp_path / "a.safetensors")["x"].tolist() == [0, 1, 2]
    code = "import sys, mien.files; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
