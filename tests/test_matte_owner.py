"""A matte holds the followed person alone: not other heads, nor things that stand apart."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from mien.capture import capture_video
from mien.capture.matte_owner import held, without_others

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


def test_what_a_hair_joins_goes_and_people_who_touch_are_cut_between_their_faces() -> None:
    found = without_others(drawn(PERSON, BOTTLE, bridge=4), FACE, NOBODY)
    assert found[:, 250:].max() == 0
    assert found[81:83, 140].min() > 200
    found = without_others(drawn(PERSON, HEAD, bridge=40), FACE, OTHER[None]) > 0
    assert found[100, :150].sum() > 100
    assert not found[:, 155:].any()  # faces of one size: the border is in the middle, between 90 and 200


def test_a_face_that_is_missed_for_some_frames_still_counts() -> None:
    others = np.full((40, 1, 4), np.nan)
    others[10] = OTHER
    assert np.isfinite(held(others, 12)[:, 0, 0]).nonzero()[0].tolist() == list(range(23))


def test_a_second_person_in_an_inset_is_not_captured(test_data: Path, tmp_path: Path) -> None:
    capture = capture_video(test_data / "cases" / "inset.mp4", tmp_path / "capture")
    mattes = np.asarray(capture.mattes)[:, 0] / 255
    assert (mattes[:, :110, 240:] > 0.5).sum(axis=(1, 2)).max() < 5  # the inset's head
    assert mattes[:, 100:180, 90:200].min() > 0.5  # the person's face
    assert capture.valid.all()
