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
    assert pace_report("clip", times)["pauses"] == 1
    assert "clip: a pause of 19.0 s without a frame, after 1.0 s" in capsys.readouterr().err


def test_dropped_and_odd_frames_do_not_change_the_rate() -> None:
    random = np.random.default_rng(0)
    kept = np.flatnonzero(random.uniform(size=300) > 0.2)
    assert frame_rate((kept - kept[0]) / 25, 25.0) == 25
    assert frame_rate((kept - kept[0]) / 25, 19.9) == pytest.approx(25)
    assert frame_rate(np.cumsum([0, *[2, 3] * 20]) / 60, 60.0) == pytest.approx(24)  # a film
    # Files of whole milliseconds say 33, 33 and 34 ms.
    assert frame_rate(np.round(np.arange(100) / 30, 3), 30.0) == 30
    for fps in (24.0, 29.97, 60.0):
        times = np.arange(90) / fps
        assert frame_rate(times, fps) == fps
        assert frame_rate(times, 2 * fps) == (len(times) - 1) / times[-1]
        assert "pauses" not in pace_report("clip", times)
    assert frame_rate(np.zeros(3), 25.0) == frame_rate(np.zeros(1), 25.0) == frame_rate(np.zeros(0), 25.0) == 25


def filmed_at(folder: Path, frames: np.ndarray, fps: float = 25.0) -> Driver:
    """Return a driver with some frames of 25 a second. Its head turns by 0.01 radians a frame; grey is their index."""
    _, sequence = toy_sequence(len(frames), 32)
    turned = torch.zeros(len(frames), 3)
    turned[:, 1] = 0.01 * torch.from_numpy(frames).float()
    gray = np.zeros_like(sequence.capture.images) + np.arange(len(frames), dtype=np.uint8)[:, None, None, None, None]
    write_capture(folder / "capture", replace(sequence.capture, timestamps=frames / 25, fps=fps, images=gray))
    tracking = replace(sequence.tracking, face=replace(sequence.tracking.face, head_rotation=turned))
    write_tracking(folder / "tracking", tracking)
    crops = np.tile(np.array([4, 4, 20, 20], np.int64), (len(frames), 1, 1))
    write_scoring(folder / "scoring", Scoring(sequence.capture.mattes, crops), read_capture_hash(folder / "capture"))
    return read_tracked_driver([folder])


def test_a_driver_moves_at_the_times_of_its_video(tmp_path: Path) -> None:
    """Every second frame of the second half is missing, and the file states the mean rate."""
    frames = np.concatenate([np.arange(20), 20 + 2 * np.arange(10)])
    driver = filmed_at(tmp_path / "half", frames, float(25 * len(frames) / frames[-1]))
    assert driver.fps == pytest.approx(25)
    torch.testing.assert_close(driver.face.head_rotation[:, 1], 0.01 * torch.arange(39), atol=1e-6, rtol=0)
    assert driver.pictures is not None
    shown = [int(driver.pictures(index)[0, 0, 0]) for index in range(39)]
    assert shown[:21] == list(range(21))
    assert np.abs(frames[shown] - np.arange(39)).max() <= 1
    assert shown[-1] == 29
    steady = filmed_at(tmp_path / "steady", np.arange(9))
    assert steady.fps == 25
    assert torch.equal(steady.face.head_rotation[:, 1], 0.01 * torch.arange(9).float())


def test_a_driver_waits_in_a_pause(tmp_path: Path) -> None:
    """In a pause of two seconds, the face is held, and it moves on just before the next frame."""
    angles = filmed_at(tmp_path, np.concatenate([np.arange(10), 60 + np.arange(10)])).face.head_rotation[:, 1]
    assert len(angles) == 70
    assert (angles[9:60] - angles[9]).abs().max() < 1e-6
    torch.testing.assert_close(angles[60:], 0.01 * torch.arange(60, 70), atol=1e-6, rtol=0)


def test_a_pause_that_never_ends_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="frame 5: comes 100 s after the one before"):
        filmed_at(tmp_path, np.concatenate([np.arange(5), 2500 + np.arange(5)]))
