"""People are told apart by the shapes of their faces before anything is written; mattes hold the followed one alone."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_helpers import tree_bytes
from mien.capture import capture_video
from mien.capture.matte_owner import held, without_others
from mien.capture.same_person import group_people, shape_difference
from mien.capture.video import read_video_frames, write_video
from mien.cli import main
from mien.training.run import check_videos, is_part_of
from refusals import refuses
from toy_workspace import write_toy_workspace

FRAMES = 12


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
    both = np.concatenate([turned, mirrored(turned)])
    both -= both.mean(1, keepdims=True)
    return both / np.sqrt(np.square(both).sum((1, 2), keepdims=True) / 37)


def mirrored(points: np.ndarray) -> np.ndarray:
    order = [*range(13), *(13 + (index ^ 1) for index in range(24))]
    return points[:, order] * (-1, 1, 1)


def test_people_are_told_apart_in_similar_and_in_mirrored_poses_alone() -> None:
    anna, again = drawn_shapes(1, 0.4, 1), drawn_shapes(1, 0.45, 2)
    assert (shape_difference(anna, again) or 9) < 0.6
    assert (shape_difference(anna, drawn_shapes(1, -0.4, 3)) or 9) < 0.9  # seen from the other side
    assert (shape_difference(anna, drawn_shapes(2, 0.4, 4)) or 0) > 2
    assert shape_difference(anna, drawn_shapes(2, 1.4, 5)) is None
    assert shape_difference(anna, drawn_shapes(2, 0.4, 6, pictures=2)) is None
    captures = [drawn_shapes(2, 0.4, 7), anna, drawn_shapes(2, 0.4, 8), again, drawn_shapes(3, 0.4, 9)]
    assert group_people(captures, [30, 100, 60, 20, 95]) == [[1, 3], [4], [0, 2]]


@pytest.fixture(scope="module")
def shots(test_data: Path) -> Callable[..., list[np.ndarray]]:
    """Return frames of two people's clips."""

    def frames(name: str, count: int) -> list[np.ndarray]:
        pictures = (picture for _, picture in read_video_frames(test_data / "footage" / f"{name}.mp4"))
        return [cv2.resize(next(pictures), (240, 240)) for _ in range(count)]

    return frames


@pytest.mark.unchecked
@pytest.mark.footage
def test_an_interview_becomes_the_avatar_of_one_person(shots: Callable[..., list[np.ndarray]], tmp_path, capsys):
    one, other = shots("wojtek", 2 * FRAMES), shots("d18", FRAMES)
    write_video(tmp_path / "talk.mp4", iter(one[:FRAMES] + other + one[FRAMES:]), 25.0)
    write_video(tmp_path / "stranger.mp4", iter(other), 25.0)

    def capture(video: str, *options: str) -> tuple[int, str]:
        command = ["capture", str(tmp_path / video), "--out", str(tmp_path / "me"), "--capture.shortest-part", "0.2"]
        return main([*command, *options]), capsys.readouterr().err

    status, said = capture("talk.mp4")
    assert status == 0
    assert "2 people, by the shapes of their faces: person 1 from 0.0, 1.0 s (24 frames); person 2 from 0.5" in said
    sequences = tmp_path / "me" / "sequences"
    assert sorted(path.name for path in sequences.iterdir()) == ["talk-1", "talk-2"]
    kept = cv2.imread(str(sequences / "talk-2" / "capture" / "frames" / "0" / "000003.png"), cv2.IMREAD_COLOR_RGB)
    assert kept is not None
    assert np.abs(kept.astype(float) - one[FRAMES + 3]).mean() < 8
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
    assert capture("stranger.mp4", "--capture.person", "0")[0] == 0


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


# Mattes ---------------------------------------------------------------------------------------------------------------


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
