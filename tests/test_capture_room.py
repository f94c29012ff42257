"""The room that a capture takes is said before it is used, and too little is refused in one line."""

import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from capture_helpers import random_capture, write_face_clip
from mien.capture import CaptureSettings, capture_video, process
from mien.capture.frame_files import FrameLayout
from mien.capture.room import capture_bytes, check_room
from mien.capture.store import write_capture
from mien.cli import main
from mien.errors import UserError

Usage = namedtuple("Usage", "total used free")


def leave(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1 << 40, 0, free))


def test_the_estimate_is_above_what_noise_without_pngs_takes(tmp_path: Path, monkeypatch, capsys) -> None:
    capture, out = random_capture(timesteps=3, height=60, width=80), tmp_path / "capture"
    write_capture(out, capture)
    raw = sum(path.stat().st_size for path in (out / "cache").glob("*.u8"))
    assert raw < capture_bytes(FrameLayout(out, capture.camera_ids, 3, 60, 80)) < 2 * raw
    layout = FrameLayout(tmp_path, tuple(f"{index:02}" for index in range(16)), 600, 802, 550)
    leave(monkeypatch, 10**12)
    check_room(layout, "talk", out)
    told = capsys.readouterr().err.strip()
    assert told.endswith("talk: 600 frames of 550x802 by 16 cameras take about 23.3 GB on disk")
    leave(monkeypatch, 10**10)
    with pytest.raises(UserError, match=r"take about 23\.3 GB on disk, and there are 10\.0 GB left; free disk space"):
        check_room(layout, "talk", out)
    # What an interrupted run has written counts as room, and a hole in a file does not.
    layout = FrameLayout(tmp_path / "work", ("front",), 100, 200, 200)
    cache = layout.folder / "cache"
    cache.mkdir(parents=True)
    leave(monkeypatch, capture_bytes(layout) - 10**6)
    with (cache / "hole.u8").open("wb") as file:
        file.truncate(10**8)
    with pytest.raises(UserError, match="left"):
        check_room(layout, "s", out)
    (cache / "frames.u8").write_bytes(bytes(range(256)) * 8000)
    check_room(layout, "s", out)


def test_too_little_room_is_refused_before_a_picture_is_written(test_data, tmp_path, monkeypatch, capsys) -> None:
    clip = tmp_path / "face.mp4"
    write_face_clip(clip, test_data)
    leave(monkeypatch, 10**6)
    with monkeypatch.context() as patched:
        patched.setattr(process, "FrameWriter", lambda *_: pytest.fail("pictures were written"))
        assert main(["capture", str(clip), "--out", str(tmp_path / "w"), "--capture.size", "200"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "12 frames of 200x200 take about 3 MB on disk, and there are 1 MB left; free disk space" in error
    assert not (tmp_path / "w" / "sequences").exists()
    leave(monkeypatch, 10**9)
    assert capture_video(clip, tmp_path / "capture", CaptureSettings(size=200)).timesteps == 12
