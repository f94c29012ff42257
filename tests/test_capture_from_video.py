"""A video becomes a capture, with the texture of a scanned face and with real footage."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_helpers import assert_same_capture, face_picture, interrupt_at, tree_bytes, write_face_clip
from mien.capture import capture_video, process, read_capture
from mien.capture.from_video import capture_video_parts
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from mien.media.video import write_video
from refusals import refuses


@pytest.fixture(scope="module")
def face_clip(test_data: Path, made_once: Callable) -> Path:
    def make(folder: Path) -> None:
        np.save(folder / "centers.npy", write_face_clip(folder / "wandering.mp4", test_data))

    return made_once("wandering", make) / "wandering.mp4"


def test_head_is_cropped_steadily_and_landmarks_follow(face_clip, tmp_path, monkeypatch):
    path, settings = tmp_path / "whole", CaptureSettings(size=200)
    capture, centers = capture_video(face_clip, path, settings), np.load(face_clip.parent / "centers.npy")
    crop = capture.source["crop"]
    assert crop["width"] == crop["height"] < 360
    assert capture.images.shape == (12, 1, 200, 200, 3)
    assert capture.valid.all()
    assert capture.fps == 25.0
    scale, corner = 200 / crop["width"], [crop["left"], crop["top"]]
    np.testing.assert_allclose(capture.principal_point, (np.array([[320, 180]]) - corner) * scale)
    # The texture moves by 4 source pixels a frame, and so must every landmark.
    moved = np.diff(capture.landmarks[:, 0].mean(axis=1), axis=0)
    np.testing.assert_allclose(moved, np.tile([4 * scale, 0], (11, 1)), atol=0.6)
    nose = (capture.landmarks[:, 0, 1] / scale + corner - centers + 120) / 240
    np.testing.assert_allclose(nose, np.tile([0.5, 0.42], (12, 1)), atol=0.03)
    report = json.loads((path / "report.json").read_text())
    assert (report["frames"], report["frames_without_face"]) == (12, 0)
    assert report["landmark_jitter_px"] < 1
    # The face is foreground, and corners are not.
    hull = np.zeros(capture.mattes.shape[2:], np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(capture.landmarks[6, 0].astype(np.float32)).astype(np.int32), 1)
    assert capture.mattes[6, 0][hull == 1].mean() > 250
    assert capture.mattes[:, 0, :4, :4].max() < 20
    # Captured again, it is read back: any work would call this function.
    before = tree_bytes(path)
    monkeypatch.setattr("mien.capture.from_video.survey_source", None)
    assert_same_capture(capture, capture_video(face_clip, path, settings))
    assert tree_bytes(path) == before


def test_a_damaged_capture_is_captured_again(face_clip, tmp_path, capsys):
    settings = CaptureSettings(size=64, max_frames=4)
    (whole,) = capture_video_parts(face_clip, tmp_path, settings)
    before = tree_bytes(tmp_path)
    file = tmp_path / "wandering/capture/frames/0/000003.png"
    file.write_bytes(file.read_bytes()[:-30])
    refuses("`mien capture`", read_capture, tmp_path / "wandering" / "capture")
    (mended,) = capture_video_parts(face_clip, tmp_path, settings)
    assert f"{file}: " in (said := capsys.readouterr().err)
    assert "it is captured again" in said
    assert_same_capture(whole, mended)
    assert tree_bytes(tmp_path) == before


def test_a_clip_is_trimmed_and_other_settings_replace_the_capture(face_clip, tmp_path):
    out = tmp_path / "capture"
    capture = capture_video(face_clip, out, CaptureSettings(size=64, start=0.08, end=0.32))
    assert capture.source["first_frame"] == 2
    np.testing.assert_allclose(capture.timestamps, np.arange(6) / 25, atol=1e-6)
    capture = capture_video(face_clip, out, CaptureSettings(size=96, max_frames=2, stride=3, start=0.04))
    assert capture.images.shape[:3] == (2, 1, 96)
    np.testing.assert_allclose(capture.timestamps, [0, 0.12], atol=1e-6)
    assert capture.fps == pytest.approx(25 / 3)
    assert [entry.name for entry in tmp_path.iterdir()] == ["capture"]


def test_interrupted_capture_goes_on_to_the_same_bytes(face_clip, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "CHUNK", 3)
    settings = CaptureSettings(size=64, max_frames=6)
    capture_video(face_clip, tmp_path / "straight" / "capture", settings)
    out = tmp_path / "interrupted" / "capture"
    calls = interrupt_at(2, monkeypatch, process.PartProcessor, "process")
    pytest.raises(KeyboardInterrupt, capture_video, face_clip, out, settings)
    refuses("no capture there", read_capture, out)
    capture_video(face_clip, out, settings)
    assert [start for _, start, *_ in calls] == [0, 3, 3]
    assert tree_bytes(out) == tree_bytes(tmp_path / "straight" / "capture")
    assert [entry.name for entry in out.parent.iterdir()] == ["capture"]


def test_folder_of_images_in_natural_order(test_data, tmp_path):
    folder, face = tmp_path / "pictures", face_picture(test_data, 128)
    folder.mkdir()
    for number in (2, 10, 1):
        picture = np.full_like(face, 190) if number == 2 else face.copy()
        picture[:8, :8] = number
        cv2.imwrite(str(folder / f"{number}.png"), picture[..., ::-1])
    capture = capture_video(folder, tmp_path / "capture", CaptureSettings(fps=10.0, crop="none"))
    assert (capture.name, capture.images[:, 0, 0, 0, 0].tolist()) == ("pictures", [1, 2, 10])
    assert capture.valid[:, 0].tolist() == np.isfinite(capture.landmarks[:, 0, 0, 0]).tolist() == [True, False, True]
    np.testing.assert_allclose(capture.timestamps, [0, 0.1, 0.2])
    assert capture.images.shape[2:4] == (128, 128)  # not enlarged
    cv2.imwrite(str(folder / "3.png"), face[:100])
    refuses("3.png: is 128x100", capture_video, folder, tmp_path / "other")
    (folder / "3.png").write_bytes(b"no image")
    refuses("3.png: cannot be read as an image", capture_video, folder, tmp_path / "other")


@pytest.mark.parametrize(("turn", "lies"), [(90, "on its side"), (180, "upside down"), (270, "on its side")])
def test_a_video_that_lies_on_its_side_is_told_and_turned(test_data, tmp_path, capsys, turn, lies):
    upright = [np.pad(face_picture(test_data, 160), ((20, 20), (60, 60), (0, 0)), mode="edge")] * 3
    path = tmp_path / "lying.mp4"
    write_video(path, iter([np.ascontiguousarray(np.rot90(picture, turn // 90)) for picture in upright]), 25, crf=8)
    with suppress(UserError):  # a face on its side may or may not be detected
        capture_video(path, tmp_path / "capture")
    assert f"the face seems to lie {lies}; if it does, add --capture.turn {turn}" in capsys.readouterr().err
    capture = capture_video(path, tmp_path / "turned", CaptureSettings(turn=turn, crop="none"))
    assert "seems to lie" not in capsys.readouterr().err
    assert np.abs(capture.images[1, 0].astype(int) - upright[1]).mean() < 3
    found = capture.landmarks[1, 0]
    assert found[33, 0] + 20 < found[263, 0], "the right eye is on the left"
    assert found[33, 1] + 20 < found[152, 1], "the chin is below"


def test_nobody_there_is_said_and_why(tmp_path):
    path = tmp_path / "nobody.mp4"
    for level, frames, remedy in (
        (8, 3, "very dark .mean level 3%.: film again"),
        (250, 3, "over-exposed"),
        (128, 5, "no face found in any of its 5 frames"),
    ):
        write_video(path, [np.full((120, 160, 3), level, np.uint8)] * frames, 25)
        error = refuses(remedy, capture_video, path, tmp_path / "capture")
        assert str(path) in error
        assert not (tmp_path / "capture").exists()


def test_bad_requests_are_refused(face_clip, tmp_path):
    for folder in ("empty", "film"):
        (tmp_path / folder).mkdir()
    (tmp_path / "film/me.MOV").touch()
    (tmp_path / "file").touch()
    for source, out, settings, message in (
        ("missing.mp4", "out", CaptureSettings(), "no such file"),
        ("empty", "out", CaptureSettings(), "holds no images; give a video or a folder"),
        ("film", "out", CaptureSettings(), "holds no images; give .*me.MOV itself"),
        (face_clip, "file", CaptureSettings(), "is a file"),
        (face_clip, "file/out", CaptureSettings(), "cannot be written"),
        (face_clip, face_clip.parent, CaptureSettings(), "holds something that is not part of a capture"),
        (face_clip, "out", CaptureSettings(start=60.0), "no frame after 60 s"),
        (face_clip, "out", CaptureSettings(start=0.08, end=0.04), "--capture.end 0.04: give a time after"),
        (face_clip, "out", CaptureSettings(stride=0), "--capture.stride 0: give 1 for every frame"),
    ):  # fmt: skip
        refuses(message, capture_video, tmp_path / source, tmp_path / out, settings)


@pytest.mark.unchecked
@pytest.mark.footage
def test_real_clip(test_data, tmp_path):
    capture = capture_video(test_data / "footage" / "wojtek.mp4", tmp_path / "capture", CaptureSettings(max_frames=16))
    assert capture.images.shape == (16, 1, 512, 512, 3)
    assert capture.valid.all()
    assert capture.source["crop"] == {"left": 0, "top": 0, "width": 512, "height": 512}
    assert json.loads((tmp_path / "capture" / "report.json").read_text())["landmark_jitter_px"] < 1.2
    # The wall behind is plain, so that a matte's mistakes are holes in the middle and a veil at the sides.
    assert capture.mattes[:, 0, :60].max() < 8
    assert capture.mattes[:, 0, 260:380, 200:300].min() > 245
    assert np.abs(np.diff(capture.mattes[:, 0].astype(float), axis=0)).mean() < 0.6
