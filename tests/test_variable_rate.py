"""Frames keep their times: a clip has the rate of its usual frames, and drivers move at the times of their video."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.capture import read_capture_hash, write_capture
from mien.capture.pace import frame_rate, pace_report
from mien.driving import read_tracked_driver
from mien.driving.drivers import Driver
from mien.errors import UserError
from mien.tracking import Scoring, write_scoring, write_tracking
from toy_scene import toy_sequence


def test_a_pause_does_not_change_the_rate(capsys: pytest.CaptureFixture[str]) -> None:
    """A pause of 20 s in a clip at 30 frames a second leaves 30, however the file states its rate."""
    times = np.concatenate([np.arange(30), 600 + np.arange(30)]) / 30
    for nominal in (30.0, 60 / times[-1], 1000.0):
        assert frame_rate(times, nominal) == pytest.approx(30)
    report = pace_report("clip", times)
    assert report["pauses"] == 1
    assert "clip: a pause of 19.0 s without a frame, after 1.0 s" in capsys.readouterr().err


def test_dropped_and_odd_frames_do_not_change_the_rate() -> None:
    random = np.random.default_rng(0)
    kept = np.flatnonzero(random.uniform(size=300) > 0.2)
    assert frame_rate((kept - kept[0]) / 25, 25.0) == 25
    assert frame_rate((kept - kept[0]) / 25, 19.9) == pytest.approx(25)
    film = np.cumsum([0, *[2, 3] * 20]) / 60
    assert frame_rate(film, 60.0) == pytest.approx(24)
    # Files of whole milliseconds say 33, 33 and 34 ms.
    assert frame_rate(np.round(np.arange(100) / 30, 3), 30.0) == 30


def test_the_rate_of_a_steady_clip_is_as_before() -> None:
    for fps in (24.0, 25.0, 29.97, 30.0, 60.0):
        times = np.arange(90) / fps
        assert frame_rate(times, fps) == fps
        assert frame_rate(times, 2 * fps) == (len(times) - 1) / times[-1]
        assert "pauses" not in pace_report("clip", times)
    assert frame_rate(np.zeros(3), 25.0) == frame_rate(np.zeros(1), 25.0) == frame_rate(np.zeros(0), 25.0) == 25


def filmed_at(folder: Path, times: np.ndarray, fps: float) -> Driver:
    """Return a driver whose head turns by 0.01 radians a second, and whose frames have their number as grey."""
    _, sequence = toy_sequence(len(times), 32)
    turned = torch.zeros(len(times), 3)
    turned[:, 1] = 0.01 * torch.from_numpy(times).float()
    gray = np.zeros_like(sequence.capture.images) + np.arange(len(times), dtype=np.uint8)[:, None, None, None, None]
    write_capture(folder / "capture", replace(sequence.capture, timestamps=times, fps=fps, images=gray))
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, head_rotation=turned))
    write_tracking(folder / "tracking", tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (len(times), 1, 1))
    write_scoring(folder / "scoring", Scoring(sequence.capture.mattes, crops), read_capture_hash(folder / "capture"))
    return read_tracked_driver([folder])


def test_a_driver_moves_at_the_times_of_its_video(tmp_path: Path) -> None:
    """Every second frame of the second half is missing, and the file states the mean rate."""
    times = np.concatenate([np.arange(20), 20 + 2 * np.arange(10)]) / 25
    driver = filmed_at(tmp_path, times, float(len(times) / times[-1]))
    assert driver.fps == pytest.approx(25)
    assert len(driver.face) == 39
    seconds = torch.arange(39) / 25
    torch.testing.assert_close(driver.face.head_rotation[:, 1], 0.01 * seconds, atol=1e-6, rtol=0)
    assert driver.pictures is not None
    shown = [int(driver.pictures(index)[0, 0, 0]) for index in range(39)]
    assert shown[:21] == list(range(21))
    assert np.abs(times[shown] - seconds.numpy()).max() < 1.01 / 25
    assert shown[-1] == 29


def test_a_steady_driver_is_not_touched(tmp_path: Path) -> None:
    times = np.arange(9) / 25
    driver = filmed_at(tmp_path, times, 25.0)
    assert driver.fps == 25
    assert torch.equal(driver.face.head_rotation[:, 1], 0.01 * torch.from_numpy(times).float())


def test_a_driver_waits_in_a_pause(tmp_path: Path) -> None:
    """In a pause of two seconds, the face is held, and it moves on just before the next frame."""
    times = np.concatenate([np.arange(10), 60 + np.arange(10)]) / 25
    driver = filmed_at(tmp_path, times, 25.0)
    assert len(driver.face) == 70
    angles = driver.face.head_rotation[:, 1]
    assert (angles[9:60] - angles[9]).abs().max() < 1e-6
    torch.testing.assert_close(angles[60:], 0.01 * torch.from_numpy(times[10:]).float(), atol=1e-6, rtol=0)


def test_a_pause_that_never_ends_is_refused(tmp_path: Path) -> None:
    times = np.concatenate([np.arange(5), 25 * 100 + np.arange(5)]) / 25
    with pytest.raises(UserError, match="frame 5: comes 100 s after the one before"):
        filmed_at(tmp_path, times, 25.0)
