"""Videos with cuts or several people are divided into parts, and each face is followed by itself.
Drawn people stand in front of plain walls, so that the true landmarks are known."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, interrupt_at, tree_bytes
from mien.capture import CaptureSettings, capture_video, capture_video_parts, process, read_capture
from mien.capture.crop import Crop
from mien.capture.faces import MAX_FACES, LandmarkDetector
from mien.capture.parts import find_cuts
from mien.capture.people import choose_person
from mien.capture.process import LandmarkFollower
from mien.capture.survey import Survey
from mien.capture.video import write_video
from mien.cli import main
from mien.commands.stages.capturing import run_capture_stage
from mien.errors import UserError
from mien.lab.synthetic import SyntheticRecipe, SyntheticScene
from mien.workspace import Workspace

FPS, FRAMES = 10.0, 11
WIDTH, HEIGHT = 400, 240
RECIPE = SyntheticRecipe(
    fps=FPS, supersample=1, texture_size=256, rotation=(12.0, 6.0, 4.0), seconds=FRAMES / FPS, width=192, height=192
)


class Actor:
    """Drawn person that can be put in front of any wall. After the last of its frames it goes back to the first."""

    def __init__(self, seed: int) -> None:
        scene = SyntheticScene(RECIPE, seed)
        self.frames = list(scene.frames())
        self.landmarks = scene.landmarks()

    def put(self, picture: np.ndarray, timestep: int, left: int, top: int) -> np.ndarray:
        """Draw the person onto a picture, also beyond its border, and return the true landmarks in it."""
        timestep = abs((timestep - FRAMES + 1) % (2 * FRAMES - 2) - FRAMES + 1)
        frame = self.frames[timestep]
        first, last = max(0, -left), min(192, picture.shape[1] - left)
        if first < last:
            place = (slice(top, top + 192), slice(left + first, left + last))
            alpha = frame.matte[:, first:last, None] / 255
            picture[place] = np.rint(frame.image[:, first:last] * alpha + picture[place] * (1 - alpha))
        return self.landmarks[timestep] + [left, top]


def wall(*level: int) -> np.ndarray:
    """Return a plain wall that is darker below."""
    shade = np.linspace(1.1, 0.8, HEIGHT)[:, None, None]
    return np.rint(np.broadcast_to(np.array(level) * shade, (HEIGHT, WIDTH, 3))).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def films(made_once: Callable[..., Path], test_data: Path) -> Path:
    """Return a folder with clip.mp4, which has shots of 11, 3, 11 and 10 frames, the last of them without a face, and
    two.mp4 with two people, and the true landmarks of both."""

    def make(folder: Path) -> None:
        ann, bob = Actor(3), face_picture(test_data, 110)

        def film(path: Path, walls: list[np.ndarray], places: list[tuple[int, int]]) -> None:
            truth = [ann.put(walls[step], step, *place) for step, place in enumerate(places)]
            np.save(path.with_suffix(".npy"), truth)
            write_video(path.with_suffix(".mp4"), iter(walls), FPS, crf=12)

        shots = ((FRAMES, (180, 170, 150), 20, 30), (3, (60, 80, 110), 190, 44), (FRAMES, (120, 150, 110), 100, 10))
        walls = [wall(*level) for count, level, _, _ in shots for _ in range(count)] + [wall(40, 90, 160)] * 10
        film(folder / "clip", walls, [(left, top) for count, _, left, top in shots for _ in range(count)])
        # She walks out to the left, stays away for half a second, and comes back; Bob, who is smaller, stays.
        lefts = [10] * 6 + [10 - 50 * step for step in range(1, 5)] + [-200] * 5
        lefts += [-190 + 50 * step for step in range(5)] + [10] * 4
        walls = [wall(120, 130, 140) for _ in lefts]
        for picture in walls:
            picture[100:210, 270:380] = bob
        film(folder / "two", walls, [(left, 24) for left in lefts])

    return made_once("capture_films", make)


shots = pytest.fixture(scope="module")(lambda films: films / "clip.mp4")


def misses(capture_dir: Path, truth: np.ndarray) -> np.ndarray:
    """Return the median distance of found from true landmarks in each frame, in source pixels, or NaN."""
    capture = read_capture(capture_dir)
    crop = capture.source["crop"]
    found = capture.landmarks[:, 0] * (crop["width"] / capture.width) + [crop["left"], crop["top"]]
    return np.median(np.linalg.norm(found - truth, axis=-1), axis=1)


def test_each_long_shot_becomes_a_sequence(shots, tmp_path, capsys, monkeypatch):
    workspace, settings, names = Workspace(tmp_path), CaptureSettings(size=160), ["clip-1", "clip-2"]
    assert run_capture_stage(workspace, shots, None, settings) == names
    said = capsys.readouterr().err
    assert "cuts to another shot at 1.1, 1.4, 2.5 s" in said
    assert "1 parts shorter than 1 s are left out, at 1.1 s" in said
    assert "1 parts without a face are left out, at 2.5 s" in said
    assert workspace.sequence_names() == names
    assert sorted(entry.name for entry in (tmp_path / "sequences").iterdir()) == names
    truth, crops = np.load(shots.with_suffix(".npy")), []
    for name, first in zip(names, (0, 14), strict=True):
        folder = workspace.sequence_dir(name) / "capture"
        capture = read_capture(folder)
        assert capture.timesteps == FRAMES
        assert capture.valid.all()
        assert (capture.source["first_frame"], capture.timestamps[0]) == (first, 0)
        # No picture belongs to the next scene: the corners of the crop show only this scene's wall.
        assert np.ptp(np.median(capture.images[:, 0, 2:8, 2:8].reshape(FRAMES, -1), axis=1)) < 6
        assert np.nanmax(misses(folder, truth[first : first + FRAMES])) < 5
        crops.append(capture.source["crop"])
    assert crops[0] != crops[1]
    # Functions that would work again are not called.
    monkeypatch.setattr("mien.capture.from_video.survey_source", None)
    assert run_capture_stage(workspace, shots, None, settings) == names


def test_cuts_can_be_ignored_and_short_parts_kept(shots, tmp_path, capsys):
    (whole,) = capture_video_parts(shots, tmp_path, CaptureSettings(size=64, cuts=False, max_frames=17))
    assert (whole.name, whole.timesteps) == ("clip", 17)
    assert "left over" not in capsys.readouterr().err
    parts = capture_video_parts(shots, tmp_path, CaptureSettings(size=64, shortest_part=0.2, max_frames=17))
    assert [(part.name, part.timesteps) for part in parts] == [("clip-1", 11), ("clip-2", 3), ("clip-3", 3)]
    assert "left over from an earlier capture of clip" in capsys.readouterr().err
    with pytest.raises(UserError, match=r"--capture.shortest-part, or --capture.no-cuts"):
        capture_video_parts(shots, tmp_path / "none", CaptureSettings(shortest_part=5.0, max_frames=17))
    assert not (tmp_path / "none").exists()
    capture_video(shots, tmp_path / "one", CaptureSettings(size=64, max_frames=17))
    assert "tracking may fail there" in capsys.readouterr().err


def test_interrupted_parts_go_on_to_the_same_bytes(shots, tmp_path, monkeypatch):
    settings = CaptureSettings(size=64, shortest_part=0.2, max_frames=17)
    capture_video_parts(shots, tmp_path / "straight", settings)
    calls = interrupt_at(2, monkeypatch, process, "PartProcessor")
    pytest.raises(KeyboardInterrupt, capture_video_parts, shots, tmp_path / "interrupted", settings)
    capture_video_parts(shots, tmp_path / "interrupted", settings)
    assert [arguments[1].name for arguments in calls] == ["clip-1", "clip-2", "clip-2", "clip-3"]
    assert tree_bytes(tmp_path / "interrupted") == tree_bytes(tmp_path / "straight")


def test_flashes_motion_and_light_are_no_cuts(test_data):
    face = face_picture(test_data, 150)

    def scene(left: int, top: int, level: int) -> np.ndarray:
        picture = np.full((270, 480, 3), level, np.uint8)
        picture[top : top + 150, left : left + 150] = face
        return picture

    still, other = [scene(20, 50, 120)] * 20, [scene(200, 60, 60)] * 20
    fast = [scene(20 + 30 * t, 50, 120) for t in range(8)]
    for pictures, cuts in (
        (still + other, [[20]]),
        (still + [np.full((270, 480, 3), 250, np.uint8)] * 2 + still, [[]]),
        (still + [((still[0].astype(int) + other[0]) // 2).astype(np.uint8)] + other, [[20], [21], [20, 21]]),
        (still + fast + [fast[-1]] * 10, [[]]),
        (still + [np.clip(picture * 1.3, 0, 255).astype(np.uint8) for picture in still], [[]]),
        (still[:1], [[]]),
    ):
        found = find_cuts(np.stack([cv2.resize(one, (32, 18), interpolation=cv2.INTER_AREA) for one in pictures]))
        assert found in cuts, (len(pictures), found)


def survey_of(frames: list[list[tuple[float, float, float, float]]]) -> Survey:
    """Return a survey of faces given as (centre x, centre y, side, colour), at 25 frames a second."""
    count = len(frames)
    boxes, looks = np.full((count, MAX_FACES, 4), np.nan), np.full((count, MAX_FACES, 27), np.nan)
    for frame, faces in enumerate(frames):
        for place, (x, y, side, color) in enumerate(faces):
            boxes[frame, place] = [x - side / 2, y - side / 2, x + side / 2, y + side / 2]
            looks[frame, place] = color
    numbers = np.arange(count, dtype=np.int64)
    thumbnails = np.zeros((count, 18, 32, 3), np.uint8)
    plain = np.zeros(count, bool), np.full(count, np.nan), np.zeros(count, bool)
    return Survey(numbers, numbers / 25, boxes, looks, thumbnails, *plain, np.full((len(numbers), 2), (640, 360)))


ANN, BOB = (0.3, 0.5, 0.3, 0.7), (0.75, 0.5, 0.2, 0.4)


def seen_of(frames: list) -> list[float | None]:
    """Return where the person who is followed is in each frame."""
    person = choose_person(survey_of(frames))
    places = np.round((person.boxes[:, 0] + person.boxes[:, 2]) / 2, 2).tolist()
    return [place if seen else None for place, seen in zip(places, person.seen, strict=True)]


def test_the_largest_and_most_persistent_is_followed_and_landmarks_of_others_are_refused():
    passing, stranger = (0.5, 0.5, 0.45, 0.5), (*ANN[:3], 0.3)
    walking = [[(0.75 - 0.025 * step, *BOB[1:])] for step in range(18)]
    for frames, seen in (
        ([[BOB, ANN]] * 10, [0.3] * 10),
        ([[ANN]] * 40 + [[passing, ANN]] * 4 + [[ANN]] * 10, [0.3] * 54),
        ([[ANN, BOB]] * 30 + [[BOB]] * 40 + [[ANN, BOB]] * 30, [0.3] * 30 + [None] * 40 + [0.3] * 30),
        # Bob moves to where Ann was; he was seen beside her, so he is not her.
        ([[ANN, BOB]] * 30 + walking, [0.3] * 30 + [None] * 18),
        # A stranger who comes later to the same place has other colours.
        ([[ANN]] * 40 + [[]] * 40 + [[stranger]] * 20, [0.3] * 40 + [None] * 60),
        ([[ANN]] * 40 + [[]] * 40 + [[ANN]] * 20, [0.3] * 40 + [None] * 40 + [0.3] * 20),
    ):
        assert seen_of(frames) == seen, frames
    crowded = choose_person(survey_of([[ANN]] * 40 + [[passing, ANN]] * 4 + [[ANN]] * 10)).crowded
    assert np.flatnonzero(crowded).tolist() == [40, 41, 42, 43]
    # A false detection, in a single frame, is nobody.
    assert not choose_person(survey_of([[ANN]] * 20 + [[ANN, (0.9, 0.1, 0.05, 0.1)]] + [[ANN]] * 20)).crowded.any()
    # Ann's centre is at 192 pixels, Bob's at 480; Ann is sometimes not found.
    survey = survey_of([[ANN, BOB], [BOB], [BOB], [ANN, BOB], [BOB], [ANN, BOB]])
    script = iter([[480, 190], [480], [185, 480], [480], [193], [480, 250]])

    class Scripted(LandmarkDetector):
        def __init__(self) -> None:
            pass

        def detect(self, image: np.ndarray) -> np.ndarray:
            return np.array([[[x - 40, 140], [x + 40, 220]] for x in next(script)], float)

    follower = LandmarkFollower(Scripted(), survey, choose_person(survey), Crop(0, 0, 640, 360, 640, 360))
    found = [follower.find(timestep, np.zeros((360, 640, 3), np.uint8)) for timestep in range(6)]
    assert [None if face is None else face[:, 0].mean() for face in found] == [190, None, 185, None, 193, 250]


def test_of_two_people_the_nearer_is_followed_and_nobody_else_while_she_is_away(films, tmp_path, capsys):
    # Uncropped, Bob is in all of the captured pictures.
    whole = ("--capture.crop", "none", "--capture.size", "400")
    assert main(["capture", str(films / "two.mp4"), "--out", str(tmp_path / "out"), *whole]) == 0
    told = re.search(r"several faces in (\d+) of 24 frames", capsys.readouterr().err)
    assert told is not None
    assert 8 <= int(told[1]) <= 18
    folder = tmp_path / "out/sequences/two/capture"
    valid = read_capture(folder).valid[:, 0]
    assert not valid[9:16].any()
    assert valid[[*range(7), *range(19, 24)]].all()
    assert np.nanmax(misses(folder, np.load(films / "two.npy"))) < 5
