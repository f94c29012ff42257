"""Gaps, huge numbers and huge files in motion, landmarks and crops are reported in time."""

from pathlib import Path

import numpy as np
import pytest

from mien.capture import given
from mien.capture.faces import LANDMARKS
from mien.capture.given import read_landmarks
from mien.driving import motion, read_blendshape_json, read_live_link_face
from mien.errors import UserError
from recordings import row, write_csv, write_json

DIGITS = int("9" * 400)


def refused(read, path: Path, words: str) -> None:
    with pytest.raises(UserError, match=words) as error:
        read(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_a_gap_in_a_csv_is_told_with_its_line(tmp_path: Path) -> None:
    """A gap in a csv is reported with its line. A year between two rows would be filled with two billion moments."""
    path = tmp_path / "a.csv"
    start = [row("0:00:00:00.0"), row("0:00:00:01.0"), row("0:00:00:02.0")]
    refused(read_live_link_face, write_csv(path, *start, row("8760:00:00:00.0")), "line 5: comes 31,536,000 s after")
    assert len(read_live_link_face(write_csv(path, *start, row("0:00:59:00.0")), fps=60.0)) == 3541


def test_many_gaps_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many gaps are reported that are not long by themselves, but are long together."""
    monkeypatch.setattr(motion, "MAX_MOMENTS", 5_000)
    start = [row(f"0:00:00:0{frame}.0") for frame in range(6)]
    later = [row(f"0:{minute:02d}:00:00.0") for minute in range(1, 5)]
    refused(read_live_link_face, write_csv(tmp_path / "a.csv", *start, *later), "give 5,760 moments, more than 5,000")


def test_a_gap_in_json_is_told_with_its_frame(tmp_path: Path) -> None:
    frames = [{"timestamp_ms": time, "blendshapes": {}} for time in (0, 33, 66, 1e12)]
    refused(read_blendshape_json, write_json(tmp_path / "a.json", frames), "frame 3: comes 1,000,000,000 s after")


def test_numbers_of_hundreds_of_digits_in_csv(tmp_path: Path) -> None:
    """Numbers of hundreds of digits in a csv are refused with their start."""
    path = tmp_path / "a.csv"
    for rows, words in (
        ([row(f"0:0:0:{DIGITS}")], "line 2: Timecode '0:0:0:9999"),
        ([row(f"{DIGITS}:0:0:0")], "line 2: Timecode '9999"),
        ([row("0:0:0:0", JawOpen=str(DIGITS))], r"JawOpen is 9{80}\.\.\.; coefficients go"),
        ([row("0:0:0:0", HeadYaw=str(DIGITS))], r"HeadYaw is 9{80}\.\.\.; angles are in radians"),
        ([row("0:0:0:0", JawOpen="x" * 5000)], r"JawOpen is 'x{80}\.\.\.', not a number"),
        ([row("0:0:0:0", JawOpen="1" + "0" * 5000)], "coefficients go from 0 to 1"),
        ([row("\u0660:\u0660:\u0660:\u0660")], "line 2: Timecode"),
    ):
        refused(read_live_link_face, write_csv(path, *rows), words)


def test_numbers_of_hundreds_of_digits_in_json(tmp_path: Path) -> None:
    """Numbers of hundreds of digits in json are refused with their start."""
    path = tmp_path / "a.json"
    matrix = {"facialTransformationMatrixes": [{"data": [*([0] * 15), DIGITS]}], "faceBlendshapes": []}
    for content, words in (
        ([{"timestamp_ms": DIGITS, "blendshapes": {}}], "timestamp_ms is 9999"),
        ([{"timestamp_ms": 1e300, "blendshapes": {}}], r"timestamp_ms is 1e\+300"),
        ([{"blendshapes": {"jawOpen": DIGITS}}], "jawOpen is 9999"),
        ([{"blendshapes": {"x" * 3000: 1}}], r"no blend shape 'x+\.\.\.$"),
        ([{"blendshapes": {"jawOpen": [[1] * 3000]}}], r"jawOpen is \[\[1"),
        (matrix, "layout of a FaceLandmarker"),
        ({**matrix, "facialTransformationMatrixes": [{"data": [1e30] * 16}]}, "contains NaN or huge numbers"),
        ({"faceBlendshapes": {"a": 1}}, "layout of a FaceLandmarker"),
        (
            {"faceBlendshapes": [{"categories": [{"categoryName": [], "score": 1}]}]},
            "layout of a FaceLandmarker",
        ),
        (
            {"faceBlendshapes": [], "facialTransformationMatrixes": {"a": 1}},
            "layout of a FaceLandmarker",
        ),
    ):
        refused(read_blendshape_json, write_json(path, content), words)
    path.write_text('[{"timestamp_ms": 1' + "0" * 5000 + ', "blendshapes": {}}]')
    refused(read_blendshape_json, path, "cannot be read as json")
    path.write_text("[" * 100_000)
    refused(read_blendshape_json, path, "cannot be read as json")


@pytest.mark.parametrize("read", [read_live_link_face, read_blendshape_json])
def test_huge_recordings_are_not_read(read, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with path.open("wb") as file:
        file.truncate(motion.MAX_FILE_BYTES + 1)
    refused(read, path, "has more than 134,217,728 bytes")


def test_landmarks_that_are_no_pixels(tmp_path: Path) -> None:
    cells = ",".join(["1"] * (2 * LANDMARKS - 1))
    (tmp_path / "a.csv").write_text(f"{cells},{DIGITS}\n{cells},1\n")
    refused(lambda path: read_landmarks(path, 2), tmp_path / "a.csv", "infinite or beyond")
    (tmp_path / "a.csv").write_text(f"{cells},1\n{cells},{'x' * 3000}\n")
    refused(lambda path: read_landmarks(path, 2), tmp_path / "a.csv", r"'x{40}\.\.\.' is not a number")


def test_only_as_many_landmarks_as_frames_are_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n" * 1000)
    read = []
    monkeypatch.setattr(given.np, "array", lambda *values, array=np.array: read.append(1) or array(*values))
    refused(lambda path: read_landmarks(path, 3), path, r"has landmarks of shape \[4, 478, 2\]")
    assert len(read) < 10
