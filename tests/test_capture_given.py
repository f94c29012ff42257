"""A capture takes clean plates, mattes and landmarks that come with a video, and respects what exists at its place."""

import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, write_gradient_video
from mien.capture import CaptureSettings, capture_video_parts
from mien.capture.given import read_landmarks
from mien.capture.plate import plate_matte
from mien.capture.video import write_video
from mien.errors import UserError
from mien.storage import write_arrays


def test_clean_plate_cuts_on_the_border_of_what_is_new():
    random = np.random.default_rng(0)
    plate = cv2.GaussianBlur(random.integers(60, 200, (160, 160, 3)).astype(np.uint8), (0, 0), 3)
    truth = np.zeros((160, 160), np.uint8)
    cv2.ellipse(truth, (80, 90), (36, 50), 0, 0, 360, 255, -1)
    picture = np.where(truth[..., None] > 0, np.array([220, 60, 60], np.uint8), plate)
    mask = cv2.GaussianBlur(np.roll(truth, 4, axis=1), (0, 0), 6).astype(np.float32) / 255
    shifted = np.roll(plate, (1, 2), axis=(0, 1))
    for scene in (plate, shifted, (plate * 0.85).astype(np.uint8)):
        alpha = plate_matte(picture, mask, scene)
        wrong = np.abs(alpha.astype(float) - truth)[8:-8, 8:-8].mean()
        assert wrong < 6, wrong
        assert wrong < 0.5 * np.abs(255 * mask - truth)[8:-8, 8:-8].mean()


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
    rows = [",".join(f"{value:.6f}" for value in row) for row in points.reshape(3, -1)]
    (tmp_path / "points.csv").write_text("\n".join(rows) + "\n")
    np.testing.assert_allclose(read_landmarks(tmp_path / "points.csv", 3), points, atol=1e-5)
    settings = CaptureSettings(crop="none", mattes=mattes, landmarks=tmp_path / "points.safetensors")
    (capture,) = capture_video_parts(clip, tmp_path / "sequences", settings)
    np.testing.assert_allclose(capture.landmarks[:, 0], points, atol=1e-4)
    assert capture.valid[:, 0].tolist() == [True, False, True]
    assert (capture.mattes == matte).all()
    (mattes / "2.png").unlink()
    with pytest.raises(UserError, match="has 2 mattes, .* has 3 frames"):
        capture_video_parts(clip, tmp_path / "other", settings)
    with pytest.raises(UserError, match=r"expected \[4, 478, 2\]"):
        read_landmarks(tmp_path / "points.csv", 4)
    cv2.imwrite(str(tmp_path / "plate.png"), matte[:100])
    with pytest.raises(UserError, match="plate.png: is 160x100, but the video's pictures are 160x160"):
        capture_video_parts(clip, tmp_path / "other", CaptureSettings(clean_plate=tmp_path / "plate.png"))
    assert not (tmp_path / "other").exists()


def test_mattes_may_be_a_video(test_data, tmp_path):
    """Mattes may be a video of any matting program.

    H.264 changes their values a little; they are cropped like the pictures.
    """
    clip, mattes = tmp_path / "clip.mp4", tmp_path / "mattes.mp4"
    write_video(clip, iter([face_picture(test_data, 160, 80)] * 5), 25.0)
    column = np.arange(320)
    ramps = [np.clip((column - 100 - 10 * index) * 4, 0, 255) for index in range(5)]
    write_video(
        mattes, iter([np.tile(ramp[None, :, None], (320, 1, 3)).astype(np.uint8) for ramp in ramps]), 25.0, crf=4
    )
    settings = CaptureSettings(size=120, stride=2, mattes=mattes)
    (capture,) = capture_video_parts(clip, tmp_path / "sequences", settings)
    crop = capture.source["crop"]
    assert crop["width"] > 120
    assert capture.timesteps == 3
    middles = crop["left"] + (np.arange(120) + 0.5) * crop["width"] / 120 - 0.5
    for index in range(3):
        expected = np.interp(middles, column, ramps[2 * index])
        assert np.abs(capture.mattes[index, 0].mean(axis=0) - expected).max() < 8
    write_video(mattes, iter([np.zeros((160, 160, 3), np.uint8)] * 5), 25.0)
    with pytest.raises(UserError, match=r"mattes.mp4: is 160x160, but the source's pictures are 320x320"):
        capture_video_parts(clip, tmp_path / "other", settings)
    write_video(mattes, iter([np.zeros((320, 320, 3), np.uint8)] * 4), 25.0)
    with pytest.raises(UserError, match=r"has 4 mattes, .* has 5 frames"):
        capture_video_parts(clip, tmp_path / "other", settings)


def test_places_are_respected(test_data, tmp_path, capsys):
    one, other = tmp_path / "one.mp4", tmp_path / "other.mp4"
    face = face_picture(test_data)
    write_video(one, iter([face] * 3), 25.0)
    write_video(other, iter([face] * 4), 25.0)
    sequences, settings = tmp_path / "ws" / "sequences", CaptureSettings(crop="none")
    capture_video_parts(one, sequences, settings, "take")
    with pytest.raises(UserError, match=r"holds a capture of another source \(one.mp4\).* --name, or add --replace"):
        capture_video_parts(other, sequences, settings, "take")
    (capture,) = capture_video_parts(other, sequences, settings, "take", replace=True)
    assert capture.timesteps == 4
    (sequences / "take" / "capture" / "capture.json").write_text("{")
    assert capture_video_parts(other, sequences, settings, "take")[0].timesteps == 4
    assert "is damaged or of another version; it is made again" in capsys.readouterr().err
    nobody = tmp_path / "nobody.mp4"
    write_gradient_video(nobody)
    with pytest.raises(UserError, match="no face"):
        capture_video_parts(nobody, tmp_path / "new" / "sequences", settings)
    assert not (tmp_path / "new").exists()
