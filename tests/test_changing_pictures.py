"""Videos whose pictures change: size, shape, what is drawn over them, alpha, and interlaced fields."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.filter import Graph
from PIL import Image

from capture_helpers import encode, face_picture, write_gradient_video
from mien.capture import capture_video
from mien.capture.from_video import capture_video_parts
from mien.capture.parts import find_cuts
from mien.capture.settings import CaptureSettings
from mien.errors import UserError
from mien.media.fields import Deinterlace
from mien.media.source import FrameSelection, open_source
from mien.media.video import LazyFrame, count_frames, probe_video, read_lazily, read_video_frames, write_video

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


FACE = np.array([0.4, 0.3, 0.6, 0.7])
OVERLAYS = {
    "a caption": (np.s_[14:17, 3:29], False), "a band over a third": (np.s_[12:, :], False),
    "a title": (np.s_[:4, :], False), "a window": (np.s_[8:, 20:], False),
    "a logo on the chin": (np.s_[11:14, 13:19], False), "another place": (np.s_[:, :], True),
    "another face in the same place": (np.s_[5:13, 12:20], True),
}  # fmt: skip


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
    assert find_cuts(film, np.broadcast_to(FACE, (30, 1, 4))) == ([10, 20] if is_cut else [])


def test_a_person_who_leaves_another_is_no_cut() -> None:
    film = np.full((20, 18, 32, 3), 120, np.uint8)
    film[:, 4:10, 4:10] = 200
    film[:10, 6:16, 16:26] = 60
    faces = np.full((20, 2, 4), np.nan)
    faces[:, 1] = np.array([4, 4, 10, 10]) / (32, 18, 32, 18)
    faces[:10, 0] = np.array([16, 6, 26, 16]) / (32, 18, 32, 18)
    assert (find_cuts(film, faces), find_cuts(film, faces[:, :1])) == ([], [10])


@pytest.mark.unchecked
def test_the_case_with_captions(test_data, tmp_path):
    (capture,) = capture_video_parts(test_data / "cases" / "captions.mp4", tmp_path, CaptureSettings(size=64))
    assert capture.timesteps == 50


SIDE = 160
_DRAWN = cv2.ellipse(np.zeros((SIDE, SIDE), np.uint8), (80, 84), (52, 70), 0, 0, 360, 255, -1)
ALPHA = cv2.GaussianBlur(_DRAWN, (0, 0), 3)
VIDEOS = {
    "prores 4444.mov": ("prores_ks", "yuva444p10le", {}),
    "vp9.webm": ("libvpx-vp9", "yuva420p", {"crf": "4", "b": "0"}),
    "vp8.webm": ("libvpx", "yuva420p", {"auto-alt-ref": "0", "b": "4000000"}),
    "png.mov": ("png", "rgba", {}),
    "ffv1.mkv": ("ffv1", "yuva444p", {}),
}
PICTURES = ("png", "webp", "tiff", "16.png", "16.tiff", "grey.png")
Pixels = np.ndarray


def colors_of(kind: str) -> Pixels:
    y, x = np.mgrid[:SIDE, :SIDE]
    return np.full((SIDE, SIDE, 3), 170) if kind == "grey" else np.dstack([180 + 0 * x, 90 + x // 4, 120 + y // 4])


def write_picture(path: Path, pixels: Pixels, kind: str) -> None:
    if kind.startswith("16"):
        cv2.imwrite(str(path), pixels[..., [2, 1, 0, 3]].astype(np.uint16) * 257)
    elif kind.startswith("grey"):
        Image.fromarray(pixels[..., [0, 3]], "LA").save(path)
    else:
        # Only WebP takes the options.
        Image.fromarray(pixels).save(path, lossless=True, exact=True)


def frame_of(path: Path) -> tuple[Pixels, Pixels | None, tuple[int, ...]]:
    """Return the first picture, its alpha, and the shape of the picture when it is shrunk."""
    source = open_source(path, FrameSelection(), 25.0)
    first = next(source.frames())
    return first.picture(), first.alpha(), next(source.frames(80)).picture().shape


# A TIFF says itself which of the two it is, and OpenCV makes the colours premultiplied.
@pytest.mark.parametrize(
    ("kind", "premultiplied"),
    [*((kind, False) for kind in [*PICTURES, *VIDEOS]), *((kind, True) for kind in ["png", "16.tiff", *VIDEOS])],
)
def test_alpha_is_read_and_hides_what_lies_under_it(kind: str, premultiplied: bool, tmp_path: Path) -> None:
    colors = colors_of(kind.split(".")[0])
    share = ALPHA[..., None] / 255
    for hidden in (0, 255):  # the colour under alpha 0, which counts nowhere
        given = colors * share if premultiplied else np.where(share > 0, colors, hidden)
        pixels: Pixels = np.dstack([np.rint(given).astype(np.uint8), ALPHA])
        if kind in VIDEOS:
            path = tmp_path / kind
            codec, layout, options = VIDEOS[kind]
            frame = av.VideoFrame.from_ndarray(pixels, format="rgba").reformat(format=layout)
            encode(path, [frame] * 2, codec, layout, options=options)
        else:
            path = tmp_path / str(hidden)
            path.mkdir()
            for index in range(2):
                write_picture(path / f"{index}.{kind.split('.')[-1]}", pixels, kind)
        picture, alpha, shrunk = frame_of(path)
        assert alpha is not None
        assert shrunk == (80, 80, 3)
        assert np.abs(alpha.astype(int) - ALPHA).mean() < 2
        wrong = np.abs(picture - (colors * share + 128 * (1 - share)))
        assert wrong.mean() < 3
        assert wrong[ALPHA == 0].mean() < 2


@pytest.mark.parametrize("kind", ["png", "webp", "tiff"])
def test_an_opaque_channel_is_no_matte(kind: str, tmp_path: Path) -> None:
    colors = colors_of(kind).astype(np.uint8)
    write_picture(tmp_path / f"0.{kind}", np.dstack([colors, np.full((SIDE, SIDE), 255, np.uint8)]), kind)
    picture, alpha, _ = frame_of(tmp_path)
    assert alpha is None
    assert (picture == colors).all()


@pytest.mark.unchecked
@pytest.mark.parametrize("turn", [0, 90])
def test_a_capture_has_the_alpha_as_its_matte_and_sees_nobody_under_it(test_data, tmp_path, capsys, turn):
    """Another face lies under alpha 0: it is not found, and the picture does not show it."""
    face = face_picture(test_data)
    wide, alpha = np.hstack([face, face]), np.hstack([ALPHA, np.zeros_like(ALPHA)])
    folder = tmp_path / "pictures"
    folder.mkdir()
    for index in range(3):
        Image.fromarray(np.rot90(np.dstack([wide, alpha]), turn // 90).copy()).save(folder / f"{index}.png")
    settings = CaptureSettings(crop="none", turn=turn)
    (capture,) = capture_video_parts(folder, tmp_path / "sequences", settings)
    assert capture.valid.all()
    assert (capture.mattes == alpha).all()
    assert (capture.images[:, 0, :, SIDE:] == 128).all()
    said = capsys.readouterr().err
    assert "its alpha is the matte" in said
    assert "several faces" not in said


@pytest.mark.unchecked
def test_mattes_that_are_given_count_more_than_alpha(test_data, tmp_path):
    folder, mattes = tmp_path / "pictures", tmp_path / "mattes.mp4"
    folder.mkdir()
    Image.fromarray(np.dstack([face_picture(test_data), ALPHA])).save(folder / "0.png")
    write_video(mattes, [np.full((SIDE, SIDE, 3), 255, np.uint8)], 25, crf=1)
    settings = CaptureSettings(crop="none", mattes=mattes)
    (capture,) = capture_video_parts(folder, tmp_path / "sequences", settings)
    assert capture.mattes.min() >= 254


HEIGHT, WIDTH, FRAMES = 96, 128, 6
FIRST = {"tff": 0, "bff": 1}
"""Lines of the first field: the even or the odd ones."""


@pytest.fixture(scope="module")
def pattern() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 255, (160, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip((smooth - smooth.mean()) * 4 + 128, 16, 235)


def read_twice(path: Path, mode: Deinterlace = "never") -> list[list[LazyFrame]]:
    return [list(read_lazily(path)), list(read_lazily(path, mode=mode))]


def moment(pattern: np.ndarray, field: int) -> np.ndarray:
    """Return what the camera sees at one field: the pattern moves by four pixels."""
    left = 8 + 4 * field
    return pattern[20 : 20 + HEIGHT, left : left + WIDTH].astype(np.uint8)


def woven(pattern: np.ndarray, order: str, frames: int = FRAMES) -> list[np.ndarray]:
    pictures = [moment(pattern, 2 * index + 1).copy() for index in range(frames)]
    for index, picture in enumerate(pictures):
        picture[FIRST[order] :: 2] = moment(pattern, 2 * index)[FIRST[order] :: 2]
    return pictures


def flagged(pictures: list[np.ndarray], pixels: str, marks: list[str]) -> list[av.VideoFrame]:
    """Return frames that are marked as tff, bff or prog: PyAV cannot set the mark itself, but a filter can."""
    frames = []
    for tick, (picture, mark) in enumerate(zip(pictures, marks, strict=True)):
        rgb = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24").reformat(format=pixels)
        frame.pts, frame.time_base = tick, Fraction(1, 25)
        graph = Graph()
        source = graph.add_buffer(
            width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 25)
        )
        graph.link_nodes(source, graph.add("setfield", f"mode={mark}"), graph.add("buffersink")).configure()
        graph.vpush(frame)
        frames.append(graph.vpull())
    return frames


CODECS = {
    "h264.mp4": ("libx264", "yuv420p", {"flags": "+ilme+ildct", "crf": "4"}),
    "h264.ts": ("libx264", "yuv420p", {"flags": "+ilme+ildct", "crf": "4"}),
    "prores.mov": ("prores_ks", "yuv422p10le", {"flags": "+ilme+ildct"}),
    "mpeg2.mpg": ("mpeg2video", "yuv420p", {"flags": "+ilme+ildct", "qscale": "2"}),
    "ffv1.mkv": ("ffv1", "yuv420p", {}),
    "raw.mov": ("rawvideo", "uyvy422", {}),
    "png.mov": ("png", "rgb24", {}),
}
CONTAINER_ORDERS = {"tff": 2, "bff": 3}


def write(path: Path, kind: str, frames: list[av.VideoFrame], order: int = 0) -> None:
    codec, pixels, options = CODECS[kind]

    def prepare(stream: av.VideoStream) -> None:
        stream.codec_context.field_order = order

    is_interlaced = any(frame.interlaced_frame for frame in frames)
    encode(path, frames, codec, pixels, options=options if is_interlaced else None, prepare=prepare)


def bend_ratio(picture: np.ndarray) -> float:
    """Return the vertical relative to the horizontal second difference: combs raise it."""
    gray = picture.astype(float)
    return float(np.abs(np.diff(gray, 2, axis=0)).mean() / np.abs(np.diff(gray, 2, axis=1)).mean())


def green(frame: LazyFrame) -> np.ndarray:
    return frame.picture()[..., 1]


@pytest.mark.parametrize(
    ("kind", "order"), [*((kind, "tff") for kind in CODECS), *((kind, "bff") for kind in ("h264.mp4", "raw.mov"))]
)
def test_each_interlaced_frame_becomes_one_picture_of_its_first_moment(kind, order, pattern, tmp_path):
    path, natural = tmp_path / kind, bend_ratio(moment(pattern, 0))
    write(path, kind, flagged(woven(pattern, order), CODECS[kind][1], [order] * FRAMES), CONTAINER_ORDERS[order])
    frames, as_stored = read_twice(path)
    assert len(frames) == count_frames(path) == FRAMES
    np.testing.assert_allclose([frame.seconds for frame in frames], np.arange(FRAMES) / 25, atol=1e-3)
    assert all(frame.is_deinterlaced for frame in frames)
    assert min(bend_ratio(green(frame)) for frame in as_stored) > 4 * natural
    for index, frame in enumerate(frames):
        assert bend_ratio(green(frame)) == pytest.approx(natural, rel=0.35)
        assert frame.combs() > 0.1, "measured before the frame was deinterlaced"
        moments = [moment(pattern, 2 * index + second) for second in (0, 1)]
        errors = [np.abs(green(frame).astype(int) - true).mean() for true in moments]
        assert errors[0] < 7 < 20 < errors[1]


def test_only_the_interlaced_frames_change_and_unmarked_ones_if_the_user_says_so(pattern, tmp_path):
    """Fields of one moment, as of a still head, lose nothing but single levels."""
    path, still = tmp_path / "mixed.mkv", moment(pattern, 0)
    pictures = [still, moment(pattern, 2), *woven(pattern, "tff")[2:4], still, still, still]
    write(path, "ffv1.mkv", flagged(pictures, "yuv420p", ["prog"] * 2 + ["tff"] * 2 + ["prog"] + ["tff"] * 2))
    auto, never = read_twice(path)
    assert [frame.is_deinterlaced for frame in auto] == [False, False, True, True, False, True, True]
    same = [bool((one.picture() == other.picture()).all()) for one, other in zip(auto, never, strict=True)]
    assert same[:5] == [True, True, False, False, True]
    assert [frame.seconds for frame in auto] == [frame.seconds for frame in never]
    assert auto[6].combs() < 0.001
    assert np.abs(green(auto[6]).astype(int) - still).mean() < 2
    path = tmp_path / "unmarked.mkv"
    write(path, "ffv1.mkv", flagged(woven(pattern, "tff"), "yuv420p", ["prog"] * FRAMES))
    for one, other in zip(*read_twice(path, "always"), strict=True):
        assert (one.is_deinterlaced, other.is_deinterlaced) == (False, True)
        assert one.combs() > 0.1
        assert bend_ratio(green(other)) < bend_ratio(green(one)) / 4


def write_single_fields(path: Path, pictures: list[np.ndarray]) -> None:
    """Write fields in HEVC, which stores each as a picture of its own, of half the height, which has no combs."""
    encode(path, pictures, "libx265", rate=50, options={"x265-params": "log-level=none:interlace=tff"})


def test_single_fields_of_hevc_are_told(pattern, tmp_path):
    path = tmp_path / "hevc.mp4"
    write_single_fields(path, [np.repeat(moment(pattern, field)[..., None], 3, axis=2) for field in range(4)])
    assert probe_video(path).has_field_pictures
    assert len(list(read_video_frames(path))) == count_frames(path) == 4
    assert not any(frame.is_deinterlaced for frame in read_lazily(path))
