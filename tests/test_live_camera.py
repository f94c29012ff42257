"""Names of cameras for `mien drive --by`, and cameras that are read while they film.
Time is an argument: the clock of a `Stage` goes on when a test lets it."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from known import known
from mien.capture.camera_names import CameraName, camera_named, is_camera
from mien.capture.live_camera import LiveCamera
from mien.capture.video import write_video
from mien.errors import UserError
from refusals import refuses
from web_case import until

FPS = 25


class Stage:
    """A clock for a camera: each wait between frames lasts until the test lets it go on, and then as long as asked."""

    def __init__(self) -> None:
        self.now = 100.0
        self.waits: list[float] = []
        self.begins: Callable[[], bool] = lambda: True
        """Whether the first frame may come."""
        self.turns = threading.Semaphore(0)

    def wait(self, stopping: threading.Event, seconds: float) -> None:
        if not self.waits:
            until(self.begins)
        elif seconds and not stopping.is_set():
            assert self.turns.acquire(timeout=60)
        self.waits.append(seconds)
        self.now += seconds

    def camera(self, name: CameraName, again: bool, say: Callable[[str], None] = lambda text: None) -> LiveCamera:
        return LiveCamera(name, again, say, lambda: self.now, self.wait)


def test_names_of_cameras_and_devices_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("camera", "camera:/dev/video7", "camera.mp4", "out/camera")
    assert [is_camera(name) for name in names] == [True, True, False, False]
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"x")
    assert camera_named(f"camera:{clip}", None).is_file
    assert camera_named("camera:rtsp://host/live", None).is_stream
    assert camera_named("camera:0", "avfoundation") == CameraName("0", "avfoundation")
    for name, words in (("", "names no camera"), (str(tmp_path), "is a folder")):
        refuses(words, camera_named, f"camera:{name}", None)
    with pytest.raises(UserError, match="there is no /dev/video99.*camera:clip.mp4|there is no /dev/video99.*these"):
        camera_named("camera:/dev/video99", "v4l2")
    monkeypatch.setattr("mien.capture.camera_names.DEVICES", tmp_path)
    for name in ("video10", "video2", "null"):
        (tmp_path / name).touch()
    refuses(f"one of these: {tmp_path}/video2, {tmp_path}/video10$", camera_named, "camera:/dev/video99", "v4l2")
    no_camera = LiveCamera(camera_named("camera:/dev/null", "v4l2"), False)
    with pytest.raises(UserError, match="camera:/dev/null: cannot be opened"), no_camera:
        pass


def test_a_file_plays_in_real_time_and_only_the_newest_frame_is_kept(tmp_path: Path) -> None:
    stage, every, clip = Stage(), 40, tmp_path / "clip.mp4"
    write_video(clip, [np.zeros((32, 48, 3), np.uint8)] * every, FPS)
    with stage.camera(camera_named(f"camera:{clip}", None), again=False) as camera:
        camera.start()
        first = known(camera.newest(-1, 120.0))
        assert (first.number, first.seconds, first.picture.shape) == (0, 100.0, (32, 48, 3))
        stage.turns.release(10)
        until(lambda: camera.frames == 11)
        later = known(camera.newest(first.number, 120.0))
        assert (later.number, later.seconds) == (10, pytest.approx(100.4))
        assert camera.newest(later.number + 1000, 0.01) is None
        assert stage.waits[1:] == pytest.approx([1 / FPS] * 10)
        until(lambda: len(stage.waits) == 11)  # it waits for the next turn
        stage.now += 0.5  # a reader that is slow
        stage.turns.release(every)
        until(lambda: camera.ended)
        assert camera.frames == every
        assert camera.error is None
    assert stage.waits[12:24] == [0] * 12, "it catches up with the clock"
    assert stage.waits[25:] == pytest.approx([1 / FPS] * (every - 25))


def test_a_camera_that_vanishes_is_taken_up_again(tmp_path: Path) -> None:
    """A stream that ends counts as a camera that vanished. Here it is a file that is taken for a stream."""
    short, away = tmp_path / "short.mp4", tmp_path / "away.mp4"
    write_video(short, [np.zeros((32, 32, 3), np.uint8)] * 5, FPS)
    said: list[str] = []
    waits: list[tuple[float, int, int]] = []

    def wait(stopping: threading.Event, seconds: float) -> None:
        waits.append((seconds, camera.frames, len(said)))
        if len(waits) == 1:
            short.rename(away)
        elif len(waits) == 4:
            away.rename(short)
        elif len(waits) == 5:
            stopping.wait(120)

    camera = LiveCamera(_Stream(str(short), "v4l2"), True, said.append, wait=wait)
    with camera:
        camera.start()
        until(lambda: len(waits) == 5)
        assert waits == [(1.0, 5, 1)] * 4 + [(1.0, 10, 3)], "it is said once"
        assert "waits until it is back" in said[0]
        assert "is back" in said[1]
        assert camera.is_lost
    assert not any(thread.name == "mien-camera" for thread in threading.enumerate())
    assert camera.error is None


class _Stream(CameraName):
    """A file that is read as fast as it can, as if it were a stream."""

    is_stream = property(lambda self: True)
    is_file = property(lambda self: False)
