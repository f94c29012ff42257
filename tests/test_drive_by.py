"""`mien drive --by` opens drivers of every kind."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.capture import Capture, read_capture_hash, write_capture
from mien.capture.video import probe_video, write_video
from mien.commands.stages import driving
from mien.commands.stages.driving import open_driver, run_driving_stage
from mien.errors import UserError
from mien.tracking import Scoring, Tracking, write_scoring, write_tracking
from mien.workspace import Workspace
from recordings import row, write_csv
from small_face_model import make_small_face_model
from toy_scene import toy_face_model, toy_sequence
from toy_workspace import write_toy_workspace

PARTS = {"clip-1": 3, "clip-2": 4, "clip-10": 2}
"""Timesteps of the parts of a video with cuts. There are so many that by letters clip-10 would come second."""


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a video whose capture and tracking are given. Each part has its own grey and its own head pose."""

    def run_capture_stage(workspace: Workspace, *_: object) -> list[str]:
        for number, (name, timesteps) in enumerate(PARTS.items(), 1):
            capture, tracking = part(number, timesteps)
            folder = workspace.sequence_dir(name)
            write_capture(folder / "capture", capture)
            write_tracking(folder / "tracking", tracking)
            crops = np.tile(np.array([4, 4, 20, 20], np.int64), (timesteps, 1, 1))
            write_scoring(folder / "scoring", Scoring(capture.mattes, crops), read_capture_hash(folder / "capture"))
        return list(PARTS)

    def run_tracking_stage(*_: object, **__: object) -> dict[str, Tracking]:
        return {name: part(1, PARTS[name])[1] for name in sorted(PARTS)}

    monkeypatch.setattr(driving, "run_capture_stage", run_capture_stage)
    monkeypatch.setattr(driving, "run_tracking_stage", run_tracking_stage)
    monkeypatch.setattr(driving, "cache_folder", lambda: tmp_path / "cache")
    path = tmp_path / "clip.mp4"
    write_video(path, [np.zeros((32, 32, 3), np.uint8)] * 2, 25.0)
    return path


def part(number: int, timesteps: int) -> tuple[Capture, Tracking]:
    _, sequence = toy_sequence(timesteps, 32)
    face = replace(sequence.tracking.face, head_rotation=torch.full((timesteps, 3), 0.01 * number))
    gray = np.full_like(sequence.capture.images, 10 * number)
    return replace(sequence.capture, images=gray), replace(sequence.tracking, face=face)


def test_a_video_with_cuts_drives_part_after_part(video: Path) -> None:
    driver = open_driver(video, None, toy_face_model())
    numbers = [1] * 3 + [2] * 4 + [3] * 2
    assert len(driver.face) == len(numbers)
    torch.testing.assert_close(driver.face.head_rotation[:, 0], 0.01 * torch.tensor(numbers))
    assert driver.pictures is not None
    assert [int(driver.pictures(index)[0, 0, 0]) for index in range(9)] == [10 * number for number in numbers]
    # All parts share one neutral face, with the head where it mostly is.
    assert float(driver.at_rest.head_rotation[0, 0]) == pytest.approx(0.02)


def test_one_part_of_a_video_can_be_chosen(video: Path) -> None:
    driver = open_driver(video, "clip-2", toy_face_model())
    assert len(driver.face) == 4
    assert driver.pictures is not None
    assert int(driver.pictures(0)[0, 0, 0]) == 20
    with pytest.raises(UserError, match="no sequence 'clip-3'; there are: clip-1, clip-10, clip-2"):
        open_driver(video, "clip-3", toy_face_model())


def test_a_film_of_all_parts(video: Path, tmp_path: Path) -> None:
    """A driver with cuts gives one film of all its parts."""
    write_toy_workspace(tmp_path / "w")
    run_driving_stage(tmp_path / "w/runs/toy", video, tmp_path / "driven.mp4")
    assert probe_video(tmp_path / "driven.mp4").frames == sum(PARTS.values())


def test_the_rate_of_a_csv_can_be_given(tmp_path: Path) -> None:
    names = ("jawOpen", *(f"other{index}" for index in range(7)))
    model = replace(make_small_face_model(), expression_names=names)
    take = write_csv(tmp_path / "a.csv", *(row(f"0:00:00:{2 * index:02d}.0", JawOpen=index / 4) for index in range(4)))
    for fps, expected in ((None, 30.0), (24.0, 12.0), (48.0, 24.0)):
        driver = open_driver(take, None, model, fps)
        assert driver.fps == pytest.approx(expected)
        assert len(driver.face) == 4
    for by, fps in ((take, -1.0), (take, float("nan")), (tmp_path, 25.0)):
        with pytest.raises(UserError, match="--fps"):
            open_driver(by, None, model, fps)
    with pytest.raises(UserError, match=r"--sequence a: .*a\.csv has no sequences"):
        open_driver(take, "a", model)
