"""Drawn people are captured on the command line: two in one picture, and three scenes with two cuts."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mien.avatar import DEFAULT_METHOD
from mien.capture import read_capture
from mien.capture.video import write_video
from mien.cli import main
from mien.lab.synthetic import SyntheticRecipe, SyntheticScene

FPS = 10.0
WIDTH, HEIGHT = 400, 240
RECIPE = SyntheticRecipe(fps=FPS, supersample=1, texture_size=256, rotation=(12.0, 6.0, 4.0))


class Actor:
    """Drawn person that can be put in front of any wall."""

    def __init__(self, seed: int, seconds: float, side: int = 192) -> None:
        self.side = side
        recipe = replace(RECIPE, seconds=seconds, width=side, height=side)
        scene = SyntheticScene(recipe, seed)
        self.frames = list(scene.frames())
        self.landmarks = scene.landmarks()

    def put(self, picture: np.ndarray, timestep: int, left: int, top: int) -> np.ndarray:
        """Draw the person onto a picture, also beyond its border, and return the true landmarks in it."""
        frame = self.frames[timestep]
        first, last = max(0, -left), min(self.side, picture.shape[1] - left)
        if first < last:
            place = (slice(top, top + self.side), slice(left + first, left + last))
            alpha = frame.matte[:, first:last, None] / 255
            mixed = frame.image[:, first:last] * alpha + picture[place] * (1 - alpha)
            picture[place] = np.rint(mixed).astype(np.uint8)
        return self.landmarks[timestep] + [left, top]


def wall(level: tuple[int, int, int]) -> np.ndarray:
    """Return a plain wall that is darker below."""
    shade = np.linspace(1.1, 0.8, HEIGHT)[:, None, None]
    return np.rint(np.broadcast_to(np.array(level) * shade, (HEIGHT, WIDTH, 3))).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def ann() -> Actor:
    return Actor(3, 3.3)


def misses(capture_dir: Path, truth: np.ndarray) -> np.ndarray:
    """Return the median distance of found from true landmarks in each frame, in source pixels, or NaN."""
    capture = read_capture(capture_dir)
    crop = capture.source["crop"]
    found = capture.landmarks[:, 0] * (crop["width"] / capture.width) + [crop["left"], crop["top"]]
    return np.median(np.linalg.norm(found - truth, axis=-1), axis=1)


@pytest.mark.slow
def test_of_two_people_the_nearer_is_followed_and_nobody_else_while_she_is_away(
    ann: Actor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bob = Actor(8, 2.4, side=96)
    pictures, truth = [], []
    # She walks out to the left, stays away for half a second, and comes back; Bob, who is smaller, stays.
    lefts = [10] * 6 + [10 - 50 * step for step in range(1, 5)] + [-200] * 5 + [-190 + 50 * step for step in range(5)]
    for timestep, left in enumerate(lefts + [10] * 4):
        picture = wall((120, 130, 140))
        bob.put(picture, timestep, 270, 100)
        truth.append(ann.put(picture, timestep, left, 24))
        pictures.append(picture)
    write_video(tmp_path / "two.mp4", iter(pictures), FPS, crf=12)
    # Uncropped, Bob is in all of the captured pictures.
    whole = ("--capture.crop", "none", "--capture.size", "400")
    assert main(["capture", str(tmp_path / "two.mp4"), "--out", str(tmp_path / "out"), *whole]) == 0
    said = capsys.readouterr().err
    assert "several faces in" in said
    capture = read_capture(tmp_path / "out/sequences/two/capture")
    away = slice(9, 16)
    assert not capture.valid[away].any()
    here = [*range(7), *range(19, len(pictures))]
    assert capture.valid[here].all()
    wrong = misses(tmp_path / "out/sequences/two/capture", np.array(truth))
    assert np.nanmax(wrong) < 5, wrong


@pytest.fixture(scope="module")
def three_scenes(ann: Actor, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Write eleven frames (1.1 s) in each of three rooms, at three places. Return the path and the true landmarks."""
    pictures, truth = [], []
    for level, left, top in (((180, 170, 150), 20, 30), ((60, 80, 110), 190, 44), ((120, 150, 110), 100, 10)):
        for _ in range(11):
            picture = wall(level)
            truth.append(ann.put(picture, len(pictures), left, top))
            pictures.append(picture)
    path = tmp_path_factory.mktemp("scenes") / "scenes.mp4"
    write_video(path, iter(pictures), FPS, crf=12)
    return path, np.array(truth)


@pytest.mark.slow
def test_three_scenes_become_three_sequences(
    three_scenes: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video, truth = three_scenes
    assert main(["capture", str(video), "--out", str(tmp_path / "out"), "--capture.size", "160"]) == 0
    assert "cuts to another shot at 1.1, 2.2 s: scenes-1, scenes-2, scenes-3" in capsys.readouterr().err
    folders = sorted((tmp_path / "out/sequences").iterdir())
    assert [folder.name for folder in folders] == ["scenes-1", "scenes-2", "scenes-3"]
    for part, folder in enumerate(folders):
        capture = read_capture(folder / "capture")
        assert capture.timesteps == 11
        assert capture.valid.all()
        assert (capture.source["first_frame"], capture.timestamps[0]) == (11 * part, 0)
        # No picture belongs to the next scene: the corners of the crop show only this scene's wall.
        corners = capture.images[:, 0, 2:8, 2:8].reshape(11, -1)
        assert np.ptp(np.median(corners, axis=1)) < 6
        assert np.nanmax(misses(folder / "capture", truth[11 * part : 11 * (part + 1)])) < 5


@pytest.mark.slow
@pytest.mark.usefixtures("short_films")
def test_a_clip_with_cuts_becomes_an_avatar(three_scenes: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    arguments = ["create", str(three_scenes[0]), "--out", str(tmp_path / "out"), "--capture.size", "128"]
    # test_subject_commands tracks several scenes together by their pixels.
    arguments += ["--tracking.schedule", "landmarks", "--tracking.keyframes", "4", "--overlay", "none"]
    assert main([*arguments, "--steps", "5", "--preset", "draft", "--hold-out", "scenes-2"]) == 0
    run = tmp_path / "out/runs" / DEFAULT_METHOD
    trained = json.loads((run / "config.json").read_text())["data"]
    assert [entry["sequence"] for entry in trained] == ["scenes-1", "scenes-2", "scenes-3"]
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["protocols"]["self_reenactment_sequence"]["frames"] == 11
