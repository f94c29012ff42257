"""Blur, darkness, over-exposure and casts of a face are reported; good pictures raise no complaint."""

import itertools

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, light_of
from mien.capture.faces import LandmarkDetector
from mien.capture.quality import measure_face, quality_report, relative_quality, skin_colors
from mien.capture.tone import srgb_signal
from mien.capture.video import read_lazily
from mien.lab.synthetic import SyntheticRecipe, SyntheticScene

SIDE = 240
FACE = np.array([[0.27 * SIDE, 0.2 * SIDE], [0.73 * SIDE, 0.76 * SIDE]])
"""Corners of the face in the scan's texture."""
WIDTH = 0.46 * SIDE


def streak(picture: np.ndarray, length: float, angle: float) -> np.ndarray:
    """Return the picture as a camera sees it if it moves by this many pixels while the shutter is open."""
    size, moved = picture.shape[1::-1], []
    for step in np.linspace(-0.5, 0.5, 33) * length:
        shift = np.array([[1, 0, step * np.cos(angle)], [0, 1, step * np.sin(angle)]])
        moved.append(cv2.warpAffine(picture, shift, size, borderMode=cv2.BORDER_REPLICATE))
    return np.rint(np.mean(moved, axis=0)).astype(np.uint8)


def noisy(picture: np.ndarray, deviation: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, deviation, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


face = pytest.fixture(scope="module")(lambda test_data: face_picture(test_data, SIDE))


@pytest.mark.parametrize(("angle", "noise"), [(0.0, 0.0), (45.0, 2.5), (90.0, 2.5), (135.0, 0.0)])
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
    pictures += [cv2.resize(face, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) for share in (0.9, 0.8)]
    measured = [measure_face(picture, FACE * len(picture) / SIDE) for picture in pictures]
    quality = relative_quality(np.array([*measured, np.full(len(measured[0]), np.nan)]))
    assert not quality.blurred.any()
    assert np.isnan(quality.sharpness[-1])


def lit(picture: np.ndarray, *light: float) -> np.ndarray:
    """Return an sRGB picture in coloured or dim light."""
    levels = np.clip(light_of(picture.astype(np.float64)) * np.array(light), 0, 1)
    return np.rint(255 * srgb_signal(levels)).astype(np.uint8)


def check_light(picture: np.ndarray, corners: np.ndarray) -> None:
    """Check that a face has no cast as it is and in black and white, and that coloured and dim light are told."""
    gray = np.repeat(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    for seen, cast, dark in (
        (picture, None, False), (gray, None, False), (lit(picture, 0.05, 0.05, 0.05), None, True),
        (lit(picture, 0.3, 1.0, 0.4), "green", None), (lit(picture, 0.15, 0.4, 1.5), "blue", None),
    ):  # fmt: skip
        measured = measure_face(seen, corners)[None]
        report = quality_report("clip", relative_quality(measured), skin_colors(measured))
        assert (report["color_cast"] or None) == cast
        assert dark is None or report["dark"] == dark


@pytest.mark.parametrize("clip", ["d3", "d6", "d9", "d14", "d18", "s18", "wojtek"])
def test_casts_and_darkness_of_real_clips(test_data, clip):
    with LandmarkDetector(False) as detector:
        for frame in itertools.islice(read_lazily(test_data / "footage" / f"{clip}.mp4"), 0, 80, 40):
            check_light(frame.picture(), detector.detect(frame.picture())[0])


@pytest.mark.unchecked
def test_casts_and_darkness_of_drawn_people():
    """Drawn people of light and dark skin have no cast unless the light has one."""
    tones = set()
    for seed in (0, 2):
        recipe = SyntheticRecipe(width=192, height=192, seconds=0.1, fps=10.0, supersample=1, texture_size=256)
        picture = SyntheticScene(recipe, seed).frame(0).image
        with LandmarkDetector(False) as detector:
            check_light(picture, detector.detect(picture)[0])
        tones.add(round(float(picture.mean())))
    assert len(tones) == 2
