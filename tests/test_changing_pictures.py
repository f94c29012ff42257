"""Videos whose pictures change: their size, their shape, and what is drawn over them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture_helpers import encode, face_picture, write_gradient_video
from mien.capture import CaptureSettings, capture_video, capture_video_parts
from mien.capture.parts import find_cuts
from mien.capture.video import read_lazily
from mien.errors import UserError

SMALL = CaptureSettings(size=200, crop="none", shortest_part=0.2)


def write_pieces(path: Path, *pieces: list[np.ndarray]) -> Path:
    """Write one stream from pieces with pictures of different sizes, as a recording of a call has them."""
    with path.open("wb") as file:
        for index, pictures in enumerate(pieces):
            encode(path.with_name(f"{index}.ts"), pictures)
            file.write(path.with_name(f"{index}.ts").read_bytes())
    return path


def resized(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


@pytest.mark.unchecked
def test_the_largest_size_is_captured_and_not_the_first(test_data, tmp_path):
    face = face_picture(test_data, 200)
    path = write_pieces(tmp_path / "call.ts", [resized(face, 64, 64)] * 4, [face] * 8, [resized(face, 100, 100)] * 2)
    assert [frame.size() for frame in read_lazily(path)] == [(64, 64)] * 4 + [(200, 200)] * 8 + [(100, 100)] * 2
    (capture,) = capture_video_parts(path, tmp_path / "sequences", SMALL)
    assert capture.source["picture_size"] == [200, 200]
    assert np.abs(capture.images[6, 0].astype(int) - face).mean() < 3
    write_gradient_video(tmp_path / "mattes.mp4", 14, 64, 64)
    settings = CaptureSettings(crop="none", mattes=tmp_path / "mattes.mp4")
    with pytest.raises(UserError, match=r"changes from 64x64 to 200x200 at 0.2 s; .* need one size: convert"):
        capture_video_parts(path, tmp_path / "other", settings)


@pytest.mark.unchecked
def test_a_telephone_that_is_turned_begins_a_part(test_data, tmp_path, capsys):
    face = face_picture(test_data, 160)
    wide, high = (cv2.copyMakeBorder(face, y, y, x, x, cv2.BORDER_REPLICATE) for x, y in ((60, 0), (0, 60)))
    path = write_pieces(tmp_path / "phone.ts", [wide] * 8, [high] * 8)
    # A change of shape is no matter of cuts.
    settings = CaptureSettings(size=200, crop="none", shortest_part=0.2, cuts=False)
    first, second = capture_video_parts(path, tmp_path / "sequences", settings)
    assert (first.timesteps, first.width, first.height) == (8, 200, 114)
    assert (second.timesteps, second.width, second.height) == (8, 114, 200)
    told = "changes from 280x160 to 160x280 at 0.3 s"
    assert f"{told}; a part begins there" in capsys.readouterr().err
    with pytest.raises(UserError, match=rf"{told}; capture it with `mien capture`, which makes a part of each shape"):
        capture_video(path, tmp_path / "whole", SMALL)
    with pytest.raises(UserError, match=r"begin at 0.0, 0.3 s, .* give a smaller --capture.shortest-part$"):
        capture_video_parts(path, tmp_path / "none", CaptureSettings(crop="none"))


@pytest.mark.unchecked
def test_frames_that_are_left_out_are_counted(test_data, tmp_path, capsys):
    face, path = face_picture(test_data), tmp_path / "a.mp4"
    encode(path, [face] * 8 + [255 - face] * 3)
    (capture,) = capture_video_parts(path, tmp_path / "sequences", SMALL)
    assert capture.timesteps == 8
    told = "a.mp4: 1 parts shorter than 0.2 s are left out, at 0.3 s: 3 of 11 frames; --capture.shortest-part"
    assert told in capsys.readouterr().err


# Cuts -----------------------------------------------------------------------------------------------------------------

FACE = np.array([0.4, 0.3, 0.6, 0.7])
OVERLAYS = {
    "a caption": (np.s_[14:17, 3:29], False),
    "a band over a third": (np.s_[12:, :], False),
    "a title": (np.s_[:4, :], False),
    "a window": (np.s_[8:, 20:], False),
    "a logo on the chin": (np.s_[11:14, 13:19], False),
    "another place": (np.s_[:, :], True),
    "another face in the same place": (np.s_[5:13, 12:20], True),
}


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("name", OVERLAYS)
def test_what_is_drawn_beside_a_face_is_no_cut(name: str, level: int) -> None:
    place, is_cut = OVERLAYS[name]
    random = np.random.default_rng(0)
    shot = random.integers(60, 200, (18, 32, 3))
    other = shot.copy()
    other[place] = random.permutation(shot.reshape(-1, 3))[: other[place].shape[0] * other[place].shape[1]].reshape(
        other[place].shape
    ) if is_cut else level  # fmt: skip
    film = np.stack([shot] * 10 + [other] * 10 + [shot] * 10)
    film = np.clip(film + random.normal(0, 1, film.shape), 0, 255).astype(np.uint8)
    faces = np.broadcast_to(FACE, (30, 1, 4))
    assert find_cuts(film, faces) == ([10, 20] if is_cut else [])


def test_a_person_who_leaves_another_is_no_cut() -> None:
    film = np.full((20, 18, 32, 3), 120, np.uint8)
    film[:, 4:10, 4:10] = 200
    film[:10, 6:16, 16:26] = 60
    faces = np.full((20, 2, 4), np.nan)
    faces[:, 1] = np.array([4, 4, 10, 10]) / (32, 18, 32, 18)
    faces[:10, 0] = np.array([16, 6, 26, 16]) / (32, 18, 32, 18)
    assert find_cuts(film, faces) == []
    assert find_cuts(film, faces[:, :1]) == [10]


@pytest.mark.unchecked
def test_the_case_with_captions(test_data, tmp_path):
    (capture,) = capture_video_parts(test_data / "cases" / "captions.mp4", tmp_path, CaptureSettings(size=64))
    assert capture.timesteps == 50
