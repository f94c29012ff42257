"""Crops, mattes and jitter, what comes with a video, and reports of blur, darkness, over-exposure and casts."""

import itertools
from dataclasses import replace
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, light_of
from mien.capture.from_video import capture_video_parts
from mien.capture.job import open_job
from mien.capture.person import backend
from mien.capture.person.backend import detector_of
from mien.capture.person.crop import choose_crop, whole_picture
from mien.capture.person.faces import IBUG68, FaceFinder, LandmarkDetector, MeshReader
from mien.capture.person.given import read_landmarks
from mien.capture.person.litert import Mesh
from mien.capture.person.matte import Segmenter, refine_matte
from mien.capture.person.plate import plate_matte
from mien.capture.quality import measure_face, quality_report, relative_quality
from mien.capture.settings import CaptureSettings
from mien.disk.files import write_arrays
from mien.errors import UserError
from mien.face import load_face_model
from mien.lab.synthetic.recipe import SyntheticRecipe
from mien.lab.synthetic.scene import SyntheticScene
from mien.media.colors import srgb_signal
from mien.media.picture_files import write_png
from mien.media.video import read_lazily, read_video_frames, write_video
from mien.tracking.landmarks.detector_response import read_response
from refusals import refuses


def boxed(center_x: float, center_y: float, side: float, width: int, height: int) -> np.ndarray:
    """Return the box of a face as parts of a picture."""
    sides = np.array([center_x, center_y] * 2) + np.array([-1, -1, 1, 1]) * side / 2
    return sides / [width, height, width, height]


def test_crop_holds_the_head_of_every_frame_and_ignores_a_false_detection():
    """It stays inside the picture, is never enlarged, and maps pixels as it maps pictures."""
    centers = np.linspace(600, 1000, 50)
    boxes = np.array([boxed(x, 500, 200, 1920, 1080) for x in centers])
    boxes[7] = np.nan
    crop = choose_crop(boxes, 1920, 1080, 512)
    assert (crop.width, crop.height) == (512, 512)
    for x in centers[1:-1]:
        corners = crop.to_output(np.array([[x - 200, 300], [x + 200, 700]]))
        np.testing.assert_array_equal(corners, corners.clip(0, 512))
    boxes = np.array([boxed(900, 500, 200, 1920, 1080)] * 200)
    narrow = choose_crop(boxes, 1920, 1080, 512)
    boxes[50] = boxed(100, 100, 60, 1920, 1080)
    assert choose_crop(boxes, 1920, 1080, 512) == narrow
    for center in ((30, 30), (1900, 1060), (960, 1070)):
        crop = choose_crop(boxed(*center, 300, 1920, 1080)[None], 1920, 1080, 512)
        assert 0 <= crop.left <= 1920 - crop.crop_width
        assert 0 <= crop.top <= 1080 - crop.crop_height
    assert choose_crop(boxed(250, 300, 190, 512, 512)[None], 512, 512, 512) == whole_picture(512, 512, 512)
    assert choose_crop(boxed(250, 240, 300, 512, 480)[None], 512, 480, 256).height == 240
    small = choose_crop(boxed(500, 300, 60, 1280, 720)[None], 1280, 720, 512)
    assert small.width == small.crop_width == 150


def test_mattes_have_their_border_on_the_edge_of_the_picture_and_of_what_is_new():
    """A matte ends at the picture's edge, although the mask is soft and 3 pixels off, as from a 256x256 network."""
    picture = np.full((512, 512, 3), 50, np.uint8)
    picture[:, 260:] = (200, 150, 130)
    truth = (np.arange(512) >= 260).astype(float)
    mask = np.broadcast_to(np.clip((np.arange(256) - 126) / 5, 0, 1), (256, 256)).astype(np.float32)
    soft = np.repeat(mask[:1], 2, axis=1)[0]
    alpha = refine_matte(picture, mask)[256] / 255
    assert np.abs(alpha - truth).sum() < 0.4 * np.abs(soft - truth).sum()
    assert (alpha[:235] == 0).all()
    assert (alpha[285:] == 1).all()
    plate = np.random.default_rng(0).integers(0, 256, (480, 480, 3)).astype(np.uint8)
    plate = cv2.GaussianBlur(plate, (0, 0), 2)
    truth = cv2.ellipse(np.zeros((480, 480), np.uint8), (240, 270), (108, 150), 0, 0, 360, 255, -1)
    picture = np.where(truth[..., None] > 0, np.array([220, 60, 60], np.uint8), plate)
    mask = cv2.GaussianBlur(np.roll(truth, 12, axis=1), (0, 0), 18).astype(np.float32) / 255
    for scene in (plate, np.roll(plate, (9, 12), axis=(0, 1)), (plate * 0.85).astype(np.uint8)):
        wrong, before = (
            np.abs(alpha.astype(float) - truth)[16:-16, 16:-16].mean()
            for alpha in (plate_matte(picture, mask, scene), 255 * mask)
        )
        assert wrong < min(2, 0.5 * before)


@pytest.mark.unchecked
def test_given_landmarks_and_mattes_are_taken_as_they_are(test_data, tmp_path):
    clip, mattes = tmp_path / "clip.mp4", tmp_path / "mattes"
    write_video(clip, iter([face_picture(test_data)] * 3), 25.0)
    mattes.mkdir()
    matte = np.tile(np.arange(160, dtype=np.uint8), (160, 1))
    for index in range(3):
        cv2.imwrite(str(mattes / f"{index}.png"), matte)
    points = np.random.default_rng(0).uniform(40, 120, (3, 478, 2)).astype(np.float32)
    points[1] = np.nan
    write_arrays(tmp_path / "points.safetensors", {"landmarks": points})
    for separator, point, encoding in (("\t", ".", "utf-16"), (";", ",", "utf-8-sig"), (",", ".", "utf-8")):
        rows = ["" if np.isnan(row).any() else separator.join(f"{value:.6f}" for value in row.flat) for row in points]
        text = "x0" + separator + "y0\n" + "\n".join(rows).replace(".", point) + "\n"
        (tmp_path / "points.csv").write_text(text, encoding)
        np.testing.assert_allclose(read_landmarks(tmp_path / "points.csv", 3), points, atol=1e-5)
    settings = CaptureSettings(crop="none", mattes=mattes, landmarks=tmp_path / "points.safetensors")
    (capture,) = capture_video_parts(clip, tmp_path / "sequences", settings)
    np.testing.assert_allclose(capture.landmarks[:, 0], points, atol=1e-4)
    assert capture.valid[:, 0].tolist() == [True, False, True]
    assert (capture.mattes == matte).all()
    (mattes / "2.png").unlink()
    refuses("has 2 mattes, .* has 3 frames", capture_video_parts, clip, tmp_path / "other", settings)
    refuses(r"expected \[4, 478, 2\]", read_landmarks, tmp_path / "points.csv", 4)
    cv2.imwrite(str(tmp_path / "plate.png"), matte[:100])
    with pytest.raises(UserError, match="plate.png: is 160x100, but the video's pictures are 160x160"):
        capture_video_parts(clip, tmp_path / "other", CaptureSettings(clean_plate=tmp_path / "plate.png"))
    assert not (tmp_path / "other").exists()


@pytest.mark.unchecked
def test_the_68_points_of_another_detector_take_the_places_of_detected_ones(test_data, tmp_path):
    """All but the contour's, and nothing is known of that detector's habits."""
    clip, settings = tmp_path / "clip.mp4", CaptureSettings(crop="none")
    write_video(clip, iter([face_picture(test_data)] * 4), 25.0)
    (detected,) = capture_video_parts(clip, tmp_path / "detected", settings)
    points = detected.landmarks[:, 0, list(IBUG68)] + 2.0
    rows = [",".join(f"{value:.4f}" for value in row.flat) for row in points]
    (tmp_path / "star.csv").write_text("\n".join([rows[0], "", *rows[2:]]))
    (capture,) = capture_video_parts(clip, tmp_path / "given", replace(settings, landmarks=tmp_path / "star.csv"))
    moved = np.zeros(478)
    moved[list(IBUG68[17:])] = 2.0
    assert capture.valid[:, 0].tolist() == [True, False, True, True]
    found = (capture.landmarks - detected.landmarks)[[0, 2, 3], 0]
    np.testing.assert_allclose(found, np.broadcast_to(moved[:, None], found.shape), atol=1e-3)
    model = load_face_model("anny")
    means = [read_response(model, 0.003, detector_of(one.source)).mean.abs().max() for one in (detected, capture)]
    assert means[0] > 1e-3 > means[1] == 0
    (tmp_path / "star.csv").write_text(f"{rows[0]}\n1,2\n")
    refuses("line 2 has 2 numbers, expected 136", read_landmarks, tmp_path / "star.csv", 4)


def test_mattes_may_be_a_video(test_data, tmp_path):
    """H.264 changes their values a little; they are cropped like the pictures."""
    clip, mattes = tmp_path / "clip.mp4", tmp_path / "mattes.mp4"
    write_video(clip, iter([face_picture(test_data, 160, 80)] * 5), 25.0)
    column = np.arange(320)
    ramps = [np.clip((column - 100 - 10 * index) * 4, 0, 255) for index in range(5)]
    write_video(mattes, [np.tile(ramp[None, :, None], (320, 1, 3)).astype(np.uint8) for ramp in ramps], 25.0, crf=4)
    settings = CaptureSettings(size=120, stride=2, mattes=mattes)
    (capture,) = capture_video_parts(clip, tmp_path / "sequences", settings)
    crop = capture.source["crop"]
    assert crop["width"] > 120
    assert capture.timesteps == 3
    middles = crop["left"] + (np.arange(120) + 0.5) * crop["width"] / 120 - 0.5
    for index in range(3):
        expected = np.interp(middles, column, ramps[2 * index])
        assert np.abs(capture.mattes[index, 0].mean(axis=0) - expected).max() < 8
    for side, count, refusal in (
        (160, 5, "mattes.mp4: is 160x160, but the source's pictures are 320x320"),
        (320, 4, "has 4 mattes, .* has 5 frames"),
    ):
        write_video(mattes, [np.zeros((side, side, 3), np.uint8)] * count, 25.0)
        refuses(refusal, capture_video_parts, clip, tmp_path / "other", settings)


@pytest.mark.unchecked
def test_places_are_respected(test_data, tmp_path, capsys):
    one, other = tmp_path / "one.mp4", tmp_path / "other.mp4"
    face = face_picture(test_data)
    write_video(one, iter([face] * 2), 25.0)
    write_video(other, iter([face] * 3), 25.0)
    sequences, settings = tmp_path / "ws" / "sequences", CaptureSettings(crop="none")
    capture_video_parts(one, sequences, settings, "take")
    with pytest.raises(UserError, match=r"holds a capture of another source \(one.mp4\).* --name, or add --replace"):
        capture_video_parts(other, sequences, settings, "take")
    (capture,) = capture_video_parts(other, sequences, settings, "take", replace=True)
    assert capture.timesteps == 3
    (sequences / "take" / "capture" / "capture.json").write_text("{")
    assert capture_video_parts(other, sequences, settings, "take")[0].timesteps == 3
    assert "is damaged or of another version; it is made again" in capsys.readouterr().err


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
    quality = relative_quality(np.array([measure_face(picture, FACE) for picture in usual + streaked]))
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
        report = quality_report("clip", relative_quality(measured), measured)
        assert (report["color_cast"] or None) == cast
        assert dark is None or report["dark"] == dark


@pytest.mark.parametrize("clip", ["d3", "d6", "d9", "d14", "d18", "s18", "wojtek"])
def test_casts_and_darkness_of_real_clips(test_data, clip):
    with LandmarkDetector(False) as detector:
        for frame in itertools.islice(read_lazily(test_data / "footage" / f"{clip}.mp4"), 0, 80, 40):
            check_light(frame.picture(), detector.detect(frame.picture())[0])


pytest.importorskip("ai_edge_litert", reason="could not import ai_edge_litert")


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    recipe = SyntheticRecipe(width=256, height=256, seconds=0.2, fps=10.0, supersample=1, texture_size=256)
    return SyntheticScene(recipe, 2).frame(0).image


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean distance of landmarks, in distances between the eyes' outer corners."""
    eyes = np.linalg.norm(one[33] - one[263])
    return float(np.linalg.norm(one - other, axis=-1).mean() / eyes)


def test_landmarks_and_mattes_are_those_of_mediapipe_on_a_drawn_face(drawn):
    with LandmarkDetector(False, "mediapipe") as own, LandmarkDetector(False, "litert") as other:
        assert apart(own.detect(drawn)[0], other.detect(drawn)[0]) < 0.03
    with MeshReader(1, False, "mediapipe") as own, MeshReader(1, False, "litert") as other:
        deep, also = own.read(drawn)[0, :, 2], other.read(drawn)[0, :, 2]
    assert np.corrcoef(deep, also)[0, 1] > 0.98
    with Segmenter("mediapipe") as own, Segmenter("litert") as other:
        assert np.abs(own.segment(drawn) - other.segment(drawn)).mean() < 0.01


@pytest.mark.parametrize("clip", ["d3", "d6", "d9", "d14", "d18", "s18", "wojtek"])
def test_landmarks_are_those_of_mediapipe_on_real_clips(test_data, clip):
    frames = [image for _, image in itertools.islice(read_video_frames(test_data / "footage" / f"{clip}.mp4"), 4)]
    with LandmarkDetector(False, "mediapipe") as own, LandmarkDetector(False, "litert") as other:
        pairs = [(own.detect(image), other.detect(image)) for image in frames]
    assert all(len(one) == len(two) == 1 for one, two in pairs)
    assert np.mean([apart(one[0], two[0]) for one, two in pairs[2:]]) < 0.03


@pytest.mark.parametrize("side", [256, 96])
def test_boxes_are_those_of_mediapipe_near_and_far(drawn, side):
    """A face that is a small part of the picture is found by the network for far faces alone."""
    wide = np.full((360, 640, 3), 150, np.uint8)
    wide[40 : 40 + side, 60 : 60 + side] = cv2.resize(drawn, (side, side), interpolation=cv2.INTER_AREA)
    with FaceFinder("mediapipe") as own, FaceFinder("litert") as other:
        one, two = own.find(wide), other.find(wide)
        assert len(one) == len(two) == 1
        assert np.abs(one - two).max() < 0.05 * (one[0, 2] - one[0, 0])
        assert own.surest(wide) == pytest.approx(other.surest(wide), abs=0.05)


def test_two_faces_are_followed_none_is_found_in_nothing_and_landmarks_turn_with_the_picture(drawn):
    beside = np.concatenate([drawn, drawn[:, ::-1]], axis=1)
    mesh = Mesh(4, follows=True)
    found = [mesh.find(np.ascontiguousarray(beside)) for _ in range(3)][-1]
    assert sorted(found[:, 1, 0] > 256) == [False, True]
    found = [mesh.find(np.zeros((100, 80, 3), np.uint8)) for _ in range(2)][-1]
    assert found.shape == (0, 478, 3)
    # The square that the network sees follows the face, also when the head lies on a shoulder.
    turned = np.ascontiguousarray(np.rot90(drawn))
    with LandmarkDetector(False, "litert") as upright, LandmarkDetector(False, "litert") as lying:
        one, two = [(upright.detect(drawn), lying.detect(turned)) for _ in range(3)][-1]
    assert apart(one[0], np.column_stack([256 - two[0, :, 1], two[0, :, 0]])) < 0.02


def test_litert_serves_where_mediapipe_is_missing_and_its_captures_are_others(drawn, tmp_path, monkeypatch):
    """Keys of captures by mediapipe are those from before the setting; by litert they differ."""
    write_png(tmp_path / "0.png", drawn)
    jobs = {
        choice: open_job(tmp_path, CaptureSettings(detector=choice), None, False)
        for choice in ("auto", "mediapipe", "litert")
    }
    assert jobs["auto"].key == jobs["mediapipe"].key != jobs["litert"].key
    entries = [backend.detector_of(backend.detector_entry(job.detector)) for job in jobs.values()]
    assert entries == ["mediapipe", "mediapipe", "litert"]
    assert backend.choose_detector() == "mediapipe"
    monkeypatch.setattr(backend, "find_spec", lambda name: None if name == "mediapipe" else find_spec(name))
    assert backend.choose_detector() == "litert"
    with pytest.raises(ModuleNotFoundError, match="mediapipe"):
        backend.choose_detector("mediapipe")
