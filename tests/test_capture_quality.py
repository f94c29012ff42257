"""Blur, darkness and over-exposure of a face are reported; good pictures raise no complaint."""

import json

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture
from mien.capture import CaptureSettings, capture_video
from mien.capture.quality import measure_face, relative_quality
from mien.capture.video import write_video
from mien.cli import main

SIDE = 240
FACE = np.array([[0.27 * SIDE, 0.2 * SIDE], [0.73 * SIDE, 0.76 * SIDE]])
"""Corners of the face in the scan's texture."""
WIDTH = 0.46 * SIDE


def streak(picture: np.ndarray, length: float, angle: float) -> np.ndarray:
    """Return the picture as a camera sees it if it moves by this many pixels while the shutter is open."""
    steps = np.linspace(-0.5, 0.5, 33) * length
    height, width = picture.shape[:2]
    moved = [
        cv2.warpAffine(
            picture,
            np.array([[1, 0, s * np.cos(angle)], [0, 1, s * np.sin(angle)]]),
            (width, height),
            borderMode=cv2.BORDER_REPLICATE,
        )
        for s in steps
    ]
    return np.rint(np.mean(moved, axis=0)).astype(np.uint8)


def noisy(picture: np.ndarray, deviation: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, deviation, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def face(test_data) -> np.ndarray:
    return face_picture(test_data, SIDE)


@pytest.mark.parametrize("noise", [0.0, 2.5])
@pytest.mark.parametrize("angle", [0.0, 45.0, 90.0, 135.0])
def test_motion_blur_is_told_from_light_blur_in_every_direction(face, angle, noise):
    usual = [noisy(face, noise, seed) for seed in range(7)]
    strengths = (0.015, 0.05, 0.1)
    streaked = [noisy(streak(face, share * WIDTH, np.deg2rad(angle)), noise, 9) for share in strengths]
    measured = np.array([measure_face(picture, FACE) for picture in usual + streaked])
    quality = relative_quality(measured)
    assert quality.blurred[:, 0].tolist() == [False] * 7 + [False, True, True]
    assert (np.diff(quality.sharpness[-4:, 0]) < 0).all(), "the stronger, the less sharp"
    np.testing.assert_allclose(np.median(quality.sharpness), 1, atol=0.1)


def test_light_distance_and_missing_faces_are_no_blur(face):
    pictures = [face] * 5 + [(face * 0.5).astype(np.uint8), np.clip(face * 1.3, 0, 255).astype(np.uint8)]
    measured = [measure_face(picture, FACE) for picture in pictures]
    measured += [
        measure_face(cv2.resize(face, None, fx=s, fy=s, interpolation=cv2.INTER_AREA), FACE * s) for s in (0.9, 0.8)
    ]
    quality = relative_quality(np.array([*measured, np.full(len(measured[0]), np.nan)]))
    assert not quality.blurred.any()
    assert np.isnan(quality.sharpness[-1])


def capture_said(tmp_path, capsys, pictures) -> tuple[str, dict]:
    """Return what `mien capture` prints about a clip, and its report."""
    write_video(tmp_path / "clip.mp4", iter(pictures), 25.0, crf=10)
    arguments = ["capture", str(tmp_path / "clip.mp4"), "--out", str(tmp_path / "out"), "--capture.no-cuts"]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "out/sequences/clip/capture/report.json").read_text())
    return capsys.readouterr().err, report


@pytest.mark.parametrize(
    ("gain", "warning", "flags"),
    [(0.2, "the face is dark", (True, False)), (1.4, "the face is over-exposed", (False, True)), (1.0, "", (0, 0))],
)
def test_dark_and_overexposed_clips_are_warned_of(face, tmp_path, capsys, gain, warning, flags):
    lit = np.clip(face.astype(np.float32) * gain, 0, 255).astype(np.uint8)
    said, report = capture_said(tmp_path, capsys, [np.pad(lit, ((30, 30), (60, 60), (0, 0)), mode="edge")] * 4)
    assert (report["dark"], report["overexposed"]) == flags
    warned = [line for line in said.splitlines() if line.startswith("warning:")]
    assert [warning in line and "record the video again" in line for line in warned] == ([True] if warning else [])


def test_blurred_frames_are_named_and_not_usable(face, tmp_path, capsys):
    wide = np.pad(face, ((30, 30), (60, 60), (0, 0)), mode="edge")
    said, report = capture_said(tmp_path, capsys, [wide] * 6 + [streak(wide, 0.07 * WIDTH, 0.0)] * 2 + [wide] * 4)
    assert "the face is blurred in 2 of 12 frames" in said
    assert report["blurred_frames"] == [6, 7]
    capture = capture_video(tmp_path / "clip.mp4", tmp_path / "again", CaptureSettings(cuts=False))
    assert capture.valid.all()
    assert np.flatnonzero(~capture.usable[:, 0]).tolist() == [6, 7]
