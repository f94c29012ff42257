"""Interlaced video: frames become progressive pictures of their first moment; what is progressive stays as it is."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.filter import Graph

from capture_helpers import encode
from mien.capture.deinterlacing import Deinterlace
from mien.capture.fields import FieldOrder, combs, deinterlace
from mien.capture.video import LazyFrame, count_frames, probe_video, read_lazily, read_video_frames

HEIGHT, WIDTH, FRAMES = 96, 128, 6
FIRST = {"tff": 0, "bff": 1}
"""Lines of the first field: the even or the odd ones."""


@pytest.fixture(scope="module")
def pattern() -> np.ndarray:
    noise = np.random.default_rng(0).uniform(0, 255, (160, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip((smooth - smooth.mean()) * 4 + 128, 16, 235)


def read_twice(path: Path, mode: Deinterlace = "never") -> list[list[LazyFrame]]:
    """Return the frames as they are read by default, and in another mode."""
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


@pytest.mark.parametrize(("pixels", "size"), [
    *((pixels, (3, 9)) for pixels in ("nv12", "rgb24", "gray", "gray16le", "yuvj420p", "yuv411p", "uyvy422")),
    *((pixels, (64, 48)) for pixels in ("nv12", "p010le")),
])  # fmt: skip
def test_any_format_and_size_passes(pixels, size):
    frames = flagged([np.full((size[1], size[0]), 180, np.uint8)] * 3, pixels, ["tff"] * 3)
    for count in (1, 2, 3):
        found = list(deinterlace(frames[:count], FieldOrder("ffv1"), "auto"))
        assert [frame.stored.pts for frame in found] == list(range(count))
        for frame in found:
            assert (frame.shown.width, frame.shown.height) == size
            shown, stored = (which.reformat(format="rgb24").to_ndarray() for which in (frame.shown, frame.stored))
            assert np.abs(shown.astype(int) - stored).max() <= 4
            assert combs(frame.stored) == 0


def test_a_clip_that_changes_its_size_passes(pattern):
    frames = flagged(woven(pattern, "tff", 4), "yuv420p", ["tff"] * 4)
    smaller = flagged([picture[:64, :64] for picture in woven(pattern, "tff", 4)], "yuv420p", ["tff"] * 4)
    given, read, found = frames[:2] + smaller[:3] + frames[2:], [], []
    for frame in deinterlace((read.append(frame) or frame for frame in given), FieldOrder("h264"), "auto"):
        found.append(frame)
        assert len(read) <= len(found) + 1
    assert [frame.shown.width for frame in found] == [128, 128, 64, 64, 64, 128, 128]
    assert [frame.stored for frame in found] == given


def write_single_fields(path: Path, pictures: list[np.ndarray]) -> None:
    """Write fields in HEVC, which stores each as a picture of its own, of half the height, which has no combs."""
    encode(path, pictures, "libx265", rate=50, options={"x265-params": "log-level=none:interlace=tff"})


def test_single_fields_of_hevc_are_told(pattern, tmp_path):
    path = tmp_path / "hevc.mp4"
    write_single_fields(path, [np.repeat(moment(pattern, field)[..., None], 3, axis=2) for field in range(4)])
    assert probe_video(path).has_field_pictures
    assert len(list(read_video_frames(path))) == count_frames(path) == 4
    assert not any(frame.is_deinterlaced for frame in read_lazily(path))
