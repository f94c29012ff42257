"""Videos with cuts or several people are divided into parts, and each face is followed by itself.
Drawn people stand in front of plain walls, so that the true landmarks are known."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, interrupt_at, tree_bytes
from mien.capture import capture_video, process, read_capture
from mien.capture.from_video import capture_video_parts
from mien.capture.parts import find_cuts
from mien.capture.person.crop import Crop
from mien.capture.person.faces import MAX_FACES, LandmarkDetector
from mien.capture.person.matte import held, without_others
from mien.capture.person.people import choose_person, group_people, shape_difference
from mien.capture.person.survey import Survey
from mien.capture.process import LandmarkFollower
from mien.capture.settings import CaptureSettings
from mien.cli import main
from mien.disk.files import write_json
from mien.disk.workspace import Workspace
from mien.errors import UserError
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.media.video import read_video_frames, write_video
from mien.pipeline.capture import check_captured, run_capture_stage
from mien.training.run import check_videos, is_part_of
from refusals import refuses
from shared_things import write_toy_workspace

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
    assert run_capture_stage(workspace, [shots], (), None, settings) == names
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
    assert run_capture_stage(workspace, [shots], (), None, settings) == names


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
    passing, stranger, farther = (0.5, 0.5, 0.45, 0.5), (*ANN[:3], 0.3), (*ANN[:2], 0.15, ANN[3])
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
        ([[ANN]] * 40 + [[]] * 40 + [[farther]] * 20, [0.3] * 40 + [None] * 40 + [0.3] * 20),
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


PICTURES = 12


def drawn_shapes(person: int, turn: float, seed: int, pictures: int = 12) -> np.ndarray:
    """Return shapes of a made-up person whose head turns by up to 0.1 about `turn`, with landmarks off by 0.5 %."""
    points = np.random.default_rng(0).normal(size=(37, 3)) + np.random.default_rng(person).normal(0, 0.1, (37, 3))
    points[13::2] = points[14::2] * (-1, 1, 1)  # the sides of the face are alike
    points[:13, 0] = 0
    random = np.random.default_rng(seed)
    angles = turn + random.uniform(-0.1, 0.1, pictures)
    rows = [np.stack([np.cos(angles), 0 * angles, np.sin(angles)], -1), np.tile([0.0, 1, 0], (pictures, 1))]
    rows.append(np.stack([-np.sin(angles), 0 * angles, np.cos(angles)], -1))
    turned = points @ np.stack(rows, -2) + random.normal(0, 0.005, (pictures, 37, 3))
    mirrored = turned[:, [*range(13), *(13 + (index ^ 1) for index in range(24))]] * (-1, 1, 1)
    both = np.concatenate([turned, mirrored])
    both -= both.mean(1, keepdims=True)
    return both / np.sqrt(np.square(both).sum((1, 2), keepdims=True) / 37)


def test_people_are_told_apart_in_similar_and_in_mirrored_poses_alone() -> None:
    anna, again = drawn_shapes(1, 0.4, 1), drawn_shapes(1, 0.45, 2)
    assert (shape_difference(anna, again) or 9) < 0.6
    assert (shape_difference(anna, drawn_shapes(1, -0.4, 3)) or 9) < 0.9  # seen from the other side
    assert (shape_difference(anna, drawn_shapes(2, 0.4, 4)) or 0) > 2
    assert shape_difference(anna, drawn_shapes(2, 1.4, 5)) is None
    assert shape_difference(anna, drawn_shapes(2, 0.4, 6, pictures=2)) is None
    captures = [drawn_shapes(2, 0.4, 7), anna, drawn_shapes(2, 0.4, 8), again, drawn_shapes(3, 0.4, 9)]
    assert group_people(captures, [30, 100, 60, 20, 95]) == [[1, 3], [4], [0, 2]]
    assert group_people([drawn_shapes(2, 1.4, 5), *captures[:2]], [10, 60, 100]) == [[0, 2], [1]], "as the first person"


@pytest.fixture(scope="module")
def frames_of(test_data: Path) -> Callable[..., list[np.ndarray]]:
    """Return frames of two people's clips."""

    def frames(name: str, count: int) -> list[np.ndarray]:
        pictures = (picture for _, picture in read_video_frames(test_data / "footage" / f"{name}.mp4"))
        return [cv2.resize(next(pictures), (240, 240)) for _ in range(count)]

    return frames


@pytest.mark.unchecked
@pytest.mark.footage
def test_an_interview_becomes_the_avatar_of_one_person(frames_of: Callable[..., list[np.ndarray]], tmp_path, capsys):
    one, other = frames_of("wojtek", 2 * PICTURES), frames_of("d18", PICTURES)
    # A picture a second: people of shorter films are not told apart for sure.
    write_video(tmp_path / "talk.mp4", iter(one[:PICTURES] + other + one[PICTURES:]), 1.0)
    write_video(tmp_path / "stranger.mp4", iter(other), 1.0)

    def capture(video: str, *options: str) -> tuple[int, str]:
        command = ["capture", str(tmp_path / video), "--out", str(tmp_path / "me"), "--capture.shortest-part", "0.2"]
        return main([*command, *options]), capsys.readouterr().err

    status, said = capture("talk.mp4")
    assert status == 0
    assert "2 people, by the shapes of their faces: person 1 from 0.0, 24.0 s (24 frames); person 2 from 12.0" in said
    sequences = tmp_path / "me" / "sequences"
    assert sorted(path.name for path in sequences.iterdir()) == ["talk-1", "talk-2"]
    kept = cv2.imread(str(sequences / "talk-2" / "capture" / "frames" / "0" / "000003.png"), cv2.IMREAD_COLOR_RGB)
    assert kept is not None
    assert np.abs(kept.astype(float) - one[PICTURES + 3]).mean() < 8
    before = tree_bytes(tmp_path / "me")
    status, said = capture("stranger.mp4")
    assert status == 2
    assert f"stranger.mp4: shows another person than {sequences / 'talk-1'}: the shapes of their faces differ" in said
    assert tree_bytes(tmp_path / "me") == before
    assert capture("talk.mp4")[0] == 0  # what is there is current
    assert tree_bytes(tmp_path / "me") == before
    status, said = capture("talk.mp4", "--capture.person", "3")
    assert status == 2
    assert "--capture.person 3: " in said
    assert tree_bytes(tmp_path / "me") == before
    given = Workspace(tmp_path / "me"), "me", [tmp_path / "talk.mp4"], ["talk"]
    check_captured(*given, CaptureSettings())
    write_json(given[0].run_dir("me") / "config.json", "mien.run", 1, {})
    check_captured(*given, CaptureSettings(shortest_part=0.2))
    refuses("run me was trained on a capture of talk.mp4 by other settings", check_captured, *given, CaptureSettings())
    assert capture("stranger.mp4", "--capture.person", "0")[0] == 0


@pytest.mark.unchecked
@pytest.mark.footage
def test_two_short_films_of_one_person_are_taken_with_a_doubt(test_data: Path, tmp_path: Path, capsys) -> None:
    """Each has four seconds, with the head in other poses, so the shapes of the face differ more than they may."""
    pictures = [picture for _, picture in read_video_frames(test_data / "footage" / "wojtek.mp4")]
    for name, first in (("one", 0), ("two", 150)):
        write_video(tmp_path / f"{name}.mp4", iter(pictures[first : first + 92 : 2]), 12.5)
        assert main(["capture", str(tmp_path / f"{name}.mp4"), "--out", str(tmp_path / "me")]) == 0
    assert f"two.mp4: may show another person than {tmp_path / 'me' / 'sequences' / 'one'}" in capsys.readouterr().err


def test_a_run_belongs_to_the_videos_that_it_was_trained_on(tmp_path: Path) -> None:
    write_toy_workspace(tmp_path, 4)  # the run `toy` of the sequence `clip`
    run = tmp_path / "runs" / "toy"
    check_videos(run, ["clip"], ["clip"])
    check_videos(tmp_path / "runs" / "new", ["second"], ["clip"])
    for names in (["second"], ["clip", "second"]):
        told = f"was trained on clip, not on {', '.join(names)}; give this run another name"
        refuses(told, check_videos, run, names, ["clip"])
    names = ("a.b", "a.b-12", "a.b-", "a.b-1-2", "axb-1")
    assert [name for name in names if is_part_of(name, "a.b")] == ["a.b", "a.b-12"]


FACE, OTHER = np.array([70.0, 60, 110, 100]), np.array([180.0, 40, 220, 80])
NOBODY = np.full((1, 4), np.nan)


def drawn(*ellipses: tuple[int, int, int, int], bridge: int = 0) -> np.ndarray:
    """Return a matte of ellipses (x, y, width, height), and of a bar of this height from the first to the right."""
    matte = np.zeros((250, 300), np.uint8)
    for x, y, width, height in ellipses:
        cv2.ellipse(matte, (x, y), (width // 2, height // 2), 0, 0, 360, 255, -1)
    matte[80 : 80 + bridge, 90:260] = 255
    return cv2.GaussianBlur(matte, (5, 5), 0)


PERSON, HEAD, BOTTLE, BODY = (90, 90, 80, 100), (200, 60, 60, 80), (260, 120, 20, 60), (90, 210, 110, 90)


@pytest.mark.parametrize(("given", "others", "wanted"), [
    pytest.param(drawn(PERSON), NOBODY, drawn(PERSON), id="alone"),
    pytest.param(drawn(PERSON, HEAD), OTHER[None], drawn(PERSON), id="another head"),
    pytest.param(drawn(PERSON, BOTTLE), NOBODY, drawn(PERSON), id="a bottle"),
    pytest.param(drawn(PERSON, BODY), NOBODY, drawn(PERSON, BODY), id="a body below a covered neck"),
    pytest.param(drawn(PERSON), OTHER[None], drawn(PERSON), id="a face that the matte does not hold"),
])  # fmt: skip
def test_what_is_not_the_person_goes(given: np.ndarray, others: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_array_equal(without_others(given, FACE, others), wanted)


def test_what_a_hair_joins_goes_and_a_face_that_is_missed_for_some_frames_still_counts() -> None:
    found = without_others(drawn(PERSON, BOTTLE, bridge=4), FACE, NOBODY)
    assert found[:, 250:].max() == 0
    assert found[81:83, 140].min() > 200
    found = without_others(drawn(PERSON, HEAD, bridge=40), FACE, OTHER[None]) > 0
    assert found[100, :150].sum() > 100
    assert not found[:, 155:].any()  # faces of one size: the border is in the middle, between 90 and 200
    others = np.full((40, 1, 4), np.nan)
    others[10] = OTHER
    assert np.isfinite(held(others, 12)[:, 0, 0]).nonzero()[0].tolist() == list(range(23))


def test_a_second_person_in_an_inset_is_not_captured(test_data: Path, tmp_path: Path) -> None:
    capture = capture_video(test_data / "cases" / "inset.mp4", tmp_path / "capture")
    mattes = np.asarray(capture.mattes)[:, 0] / 255
    assert (mattes[:, :110, 240:] > 0.5).sum(axis=(1, 2)).max() < 5  # the inset's head
    assert mattes[:, 100:180, 90:200].min() > 0.5  # the person's face
    assert capture.valid.all()
