"""Videos with cuts or several people are divided into parts, and each face is followed by itself."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, tree_bytes
from mien.capture import CaptureSettings, capture_video, capture_video_parts, read_capture
from mien.capture.crop import Crop
from mien.capture.faces import MAX_FACES, LandmarkDetector
from mien.capture.parts import find_cuts
from mien.capture.people import choose_person
from mien.capture.process import LandmarkFollower
from mien.capture.survey import Survey
from mien.capture.video import write_video
from mien.commands.stages.capturing import run_capture_stage
from mien.errors import UserError
from mien.workspace import Workspace


def scene(face: np.ndarray, left: int, top: int, level: int, size: tuple[int, int] = (480, 270)) -> np.ndarray:
    picture = np.full((size[1], size[0], 3), level, np.uint8)
    picture[top : top + face.shape[0], left : left + face.shape[1]] = face
    return picture


@pytest.fixture(scope="session")
def shots(test_data, tmp_path_factory):
    """Return a video of four shots: 30 frames, 8 frames, 30 frames, and 26 frames without a face."""
    face = face_picture(test_data, 150)
    small = face_picture(test_data, 110)
    pictures = [scene(face, 20 + t, 50, 190) for t in range(30)]
    pictures += [scene(face, 200, 60, 90) for _ in range(8)]
    pictures += [scene(small, 330 - t, 120, 130) for t in range(30)]
    pictures += [np.full((270, 480, 3), (40, 90, 160), np.uint8)] * 26
    path = tmp_path_factory.mktemp("shots") / "clip.mp4"
    write_video(path, iter(pictures), 25.0, crf=12)
    return path


def test_each_long_shot_becomes_a_sequence(shots, tmp_path, capsys, monkeypatch):
    workspace = Workspace(tmp_path)
    settings = CaptureSettings(size=256)
    assert run_capture_stage(workspace, shots, None, settings) == ["clip-1", "clip-2"]
    said = capsys.readouterr().err
    assert "cuts to another shot at 1.2, 1.5, 2.7 s" in said
    assert "1 parts shorter than 1 s are left out, at 1.2 s" in said
    assert "1 parts without a face are left out, at 2.7 s" in said
    assert workspace.sequence_names() == ["clip-1", "clip-2"]
    assert sorted(entry.name for entry in (tmp_path / "sequences").iterdir()) == ["clip-1", "clip-2"]
    first, second = (read_capture(workspace.sequence_dir(name) / "capture") for name in ("clip-1", "clip-2"))
    assert (first.timesteps, second.timesteps) == (30, 30)
    assert second.timestamps[0] == 0
    assert (first.source["first_frame"], second.source["first_frame"]) == (0, 38)
    assert first.source["crop"] != second.source["crop"]
    # Functions that would work again are not called.
    monkeypatch.setattr("mien.capture.from_video.survey_source", None)
    assert run_capture_stage(workspace, shots, None, settings) == ["clip-1", "clip-2"]


def test_cuts_can_be_ignored_and_short_parts_kept(shots, tmp_path, capsys):
    (whole,) = capture_video_parts(shots, tmp_path, CaptureSettings(size=64, cuts=False, max_frames=45))
    assert (whole.name, whole.timesteps) == ("clip", 45)
    parts = capture_video_parts(shots, tmp_path, CaptureSettings(size=64, shortest_part=0.2, max_frames=45))
    assert [(part.name, part.timesteps) for part in parts] == [("clip-1", 30), ("clip-2", 8), ("clip-3", 7)]
    assert "sequences" not in capsys.readouterr().err.split("left over from an earlier capture of clip")[0][-20:]
    with pytest.raises(UserError, match=r"--capture.shortest-part, or --capture.no-cuts"):
        capture_video_parts(shots, tmp_path / "none", CaptureSettings(shortest_part=5.0, max_frames=45))
    assert not (tmp_path / "none").exists()
    capture_video(shots, tmp_path / "one", CaptureSettings(size=64, max_frames=45))
    assert "tracking may fail there" in capsys.readouterr().err


def test_interrupted_parts_go_on_to_the_same_bytes(shots, tmp_path, monkeypatch):
    settings = CaptureSettings(size=64, shortest_part=0.2, max_frames=45)
    capture_video_parts(shots, tmp_path / "straight", settings)
    from mien.capture import from_video

    original, calls = from_video.process_part, []

    def stop_at_the_second(*arguments, **options):
        calls.append(arguments[1].name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(from_video, "process_part", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        capture_video_parts(shots, tmp_path / "interrupted", settings)
    capture_video_parts(shots, tmp_path / "interrupted", settings)
    assert calls == ["clip-1", "clip-2", "clip-2", "clip-3"]
    assert tree_bytes(tmp_path / "interrupted") == tree_bytes(tmp_path / "straight")


def thumbnails_of(pictures: list[np.ndarray]) -> np.ndarray:
    return np.stack([cv2.resize(picture, (32, 18), interpolation=cv2.INTER_AREA) for picture in pictures])


def test_flashes_motion_and_light_are_no_cuts(test_data):
    face = face_picture(test_data, 150)
    still = [scene(face, 20, 50, 120)] * 20
    other = [scene(face, 200, 60, 60)] * 20
    flash = [np.full((270, 480, 3), 250, np.uint8)] * 2
    blended = [((still[0].astype(int) + other[0]) // 2).astype(np.uint8)]
    fast = [scene(face, 20 + 30 * t, 50, 120) for t in range(8)]
    brighter = [np.clip(picture * 1.3, 0, 255).astype(np.uint8) for picture in still]
    assert find_cuts(thumbnails_of(still + other)) == [20]
    assert find_cuts(thumbnails_of(still + flash + still)) == []
    assert set(find_cuts(thumbnails_of(still + blended + other))) & {20, 21}
    assert find_cuts(thumbnails_of(still + fast + [fast[-1]] * 10)) == []
    assert find_cuts(thumbnails_of(still + brighter)) == []
    assert find_cuts(thumbnails_of(still[:1])) == []


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
    plain = np.zeros(count, bool), np.full(count, np.nan)
    return Survey(numbers, numbers / 25, boxes, looks, thumbnails, *plain, np.array([640, 360], np.int64))


ANN, BOB = (0.3, 0.5, 0.3, 0.7), (0.75, 0.5, 0.2, 0.4)


def centers(person) -> list[float]:
    return np.round((person.boxes[:, 0] + person.boxes[:, 2]) / 2, 2).tolist()


def test_the_largest_and_most_persistent_is_followed():
    assert centers(choose_person(survey_of([[BOB, ANN]] * 10))) == [0.3] * 10
    # A larger face that passes by does not win.
    passing = (0.5, 0.5, 0.45, 0.5)
    person = choose_person(survey_of([[ANN]] * 40 + [[passing, ANN]] * 4 + [[ANN]] * 10))
    assert centers(person) == [0.3] * 54
    assert np.flatnonzero(person.crowded).tolist() == [40, 41, 42, 43]


def test_nobody_takes_the_place_of_who_is_away():
    frames = [[ANN, BOB]] * 30 + [[BOB]] * 40 + [[ANN, BOB]] * 30
    person = choose_person(survey_of(frames))
    assert person.seen.tolist() == [True] * 30 + [False] * 40 + [True] * 30
    assert person.crowded.all()
    # Bob moves to where Ann was; he was seen beside her, so he is not her.
    moved = [[(0.75 - 0.025 * step, *BOB[1:])] for step in range(18)]
    person = choose_person(survey_of([[ANN, BOB]] * 30 + moved))
    assert person.seen.tolist() == [True] * 30 + [False] * 18
    # A stranger who comes later to the same place has other colours.
    stranger = (*ANN[:3], 0.3)
    person = choose_person(survey_of([[ANN]] * 40 + [[]] * 40 + [[stranger]] * 20))
    assert person.seen.tolist() == [True] * 40 + [False] * 60
    person = choose_person(survey_of([[ANN]] * 40 + [[]] * 40 + [[ANN]] * 20))
    assert person.seen.tolist() == [True] * 40 + [False] * 40 + [True] * 20
    assert not person.crowded.any()


def test_false_detections_are_nobody():
    person = choose_person(survey_of([[ANN]] * 20 + [[ANN, (0.9, 0.1, 0.05, 0.1)]] + [[ANN]] * 20))
    assert not person.crowded.any()


class _ScriptedDetector(LandmarkDetector):
    """Detector that finds what its script says."""

    def __init__(self, script: Sequence[Sequence[float]]) -> None:
        self._script = iter(script)

    def detect(self, image: np.ndarray) -> np.ndarray:
        square = np.array([[-40.0, -40.0], [40.0, 40.0]])
        found = [square + [x, 180] for x in next(self._script)]
        return np.array(found).reshape(-1, 2, 2)


def test_landmarks_of_others_are_refused():
    """Landmarks on another person are refused.

    Ann's centre is at 192 pixels, Bob's at 480; Ann is sometimes not found.
    """
    survey = survey_of([[ANN, BOB], [BOB], [BOB], [ANN, BOB], [BOB], [ANN, BOB]])
    script = [[480, 190], [480], [185, 480], [480], [193], [480, 250]]
    follower = LandmarkFollower(
        _ScriptedDetector(script), survey, choose_person(survey), Crop(0, 0, 640, 360, 640, 360)
    )
    found = [follower.find(timestep, np.zeros((360, 640, 3), np.uint8)) for timestep in range(6)]
    middles = [None if face is None else float(face[:, 0].mean()) for face in found]
    assert middles == [190, None, 185, None, 193, 250]
