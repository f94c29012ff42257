"""The colours of cameras are corrected as the polynomial's formula says, in pictures and clean plates."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import color_charts
from capture_helpers import write_rig
from dataset_writers import FRONTAL, write_nersemble
from mien.capture.calibration import read_calibration
from mien.capture.color_correction import ColorCorrection
from mien.capture.crop import whole_picture
from mien.capture.given import read_given
from mien.capture.settings import CaptureSettings
from mien.capture.source import FrameSelection, open_source
from mien.cli import main
from mien.commands.stages import import_footage
from mien.errors import UserError

ENTRY = {"id": "a", "K": [[300, 0, 40], [0, 300, 30], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "width": 80,
         "height": 60}  # fmt: skip
SERIALS = ("222200036", FRONTAL)


def noise(seed: int, height: int = 60, width: int = 80) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def expected(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    light = color_charts.to_light(picture.reshape(-1, 3) / 255)
    return 255 * color_charts.to_srgb(color_charts.polynomial(light, matrix)).reshape(picture.shape)


@pytest.mark.parametrize("terms", sorted(color_charts.ORDERS))
def test_colors_follow_the_formula(terms: int) -> None:
    """To rounding, in every number of terms. Each exchange of two terms would be seen."""
    picture, matrix = noise(terms), color_charts.correction(terms, terms)
    found = ColorCorrection(matrix).apply(picture).astype(float)
    assert np.abs(found - expected(picture, matrix)).max() < 0.6
    for one in range(terms - 1):
        exchanged = matrix.copy()
        exchanged[:, [one, one + 1]] = matrix[:, [one + 1, one]]
        assert np.abs(found - expected(picture, exchanged)).max() > 2, f"terms {one} and {one + 1}"
    greys = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    assert (ColorCorrection(np.eye(3)).apply(greys) == greys).all()
    assert ColorCorrection(-np.eye(3)).apply(greys).max() == 0
    assert (ColorCorrection(1e6 * np.eye(3)).apply(greys)[0, 1:] == 255).all()


def test_pictures_and_plates_are_corrected_and_mattes_are_not(tmp_path: Path) -> None:
    matrix = color_charts.correction(5)
    entry = {**ENTRY, "color_correction": matrix.tolist()}
    rig = write_rig(tmp_path / "rig.json", entry)
    (camera,) = read_calibration(rig)
    assert camera.colors is not None
    for name, seed in (("pictures/0.png", 1), ("plate.png", 2), ("mattes/0.png", 3)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), noise(seed)[..., ::-1])
    source = replace(open_source(tmp_path / "pictures", FrameSelection(), 25.0), colors=camera.colors)
    assert np.abs(next(source.frames()).picture() - expected(noise(1), matrix)).max() < 0.6
    given = read_given(CaptureSettings(clean_plate=tmp_path / "plate.png", mattes=tmp_path / "mattes"), source)
    assert given.plate is not None
    assert given.mattes is not None
    assert np.abs(given.plate - expected(noise(2), matrix)).max() < 0.6
    assert (given.mattes.matte(0, whole_picture(80, 60, 80)) == noise(3)[..., 1]).all()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ([[1, 0, 0], [0, 1, 0], [0, 0]], "is not three rows of numbers"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1e30]], "is not three rows of numbers"),
        ([[], [], []], "has 0 terms for each channel"),
        ("red", "is not three rows of numbers"),
        (np.zeros((3, 6)).tolist(), "has 6 terms for each channel; polynomials of Cheung 2004 have 3, 4, 5, 7, 8, 10,"),
    ],
)
def test_other_matrices_are_refused(tmp_path: Path, given: object, told: str) -> None:
    rig = write_rig(tmp_path / "rig.json", {**ENTRY, "color_correction": given})
    with pytest.raises(UserError, match=rf"camera 0 \(a\): color_correction.* {told}"):
        read_calibration(rig)


def test_the_option_leaves_colors_as_filmed(tmp_path: Path, monkeypatch, capsys) -> None:
    """A person without the file is captured so as well. A file that cannot be used stops only those who want it."""
    asked: list[dict[str, Any]] = []

    def capture(videos: list[Path], calibration: Path, out: Path, name: str, settings: CaptureSettings) -> None:
        asked.append({each.camera_id: each.colors for each in read_calibration(calibration)})
        out.mkdir(parents=True)

    def told(person: Path, out: str, *options: str, code: int = 0) -> str:
        assert main(["import", str(person), "--out", str(tmp_path / out), *options]) == code
        return capsys.readouterr().err

    monkeypatch.setattr(import_footage, "capture_cameras", capture)
    corrections = {serial: color_charts.correction(index) for index, serial in enumerate(SERIALS)}
    person = write_nersemble(tmp_path / "017", SERIALS, colors=corrections)
    by_file = "  colour correction: by calibration/color_calibration.json; --no-color-correction leaves it out"
    assert by_file in told(person, "a")
    for serial, found in asked[0].items():
        np.testing.assert_array_equal(found.matrix, corrections[serial])
    assert "  colour correction: left out (--no-color-correction)" in told(person, "b", "--no-color-correction")
    file = person / "calibration/color_calibration.json"
    for content, reason in (
        ({FRONTAL: corrections[FRONTAL].tolist()}, "has no correction of the camera 222200036; copy the files"),
        ({serial: np.zeros((3, 6)).tolist() for serial in SERIALS}, "'222200036': has 6 terms for each channel"),
    ):
        file.write_text(json.dumps(content))
        assert f"mien: {file}: {reason}" in told(person, "c", code=2)
        assert not list(tmp_path.glob("c/sequences/*/*"))
    told(person, "c", "--no-color-correction")
    without = told(write_nersemble(tmp_path / "018", SERIALS), "d")
    assert "  missing or not used: colour correction (calibration/color_calibration.json): cameras differ" in without
    assert "  colour correction:" not in without
    assert asked[1:] == [dict.fromkeys(SERIALS)] * 3
