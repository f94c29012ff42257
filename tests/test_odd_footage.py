"""Odd videos by what `mien capture` says of them, what its report holds, and what is in the capture.

A new kind of footage is a function that writes a small video, and a row of `ODD`. Videos that are refused are rows of
`test_capture_from_video::test_nobody_there_is_said_and_why` and `test_bad_requests_are_refused` there.

Of several streams in a file, every reader takes the one that is the video, and the user may choose another."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from capture_helpers import BT709, BT2020, encode, face_picture, hdr_signal, light_of, to_planes, write_planes
from mien.capture import capture_video, read_capture
from mien.capture.capture import Capture
from mien.capture.settings import CaptureSettings
from mien.cli import main
from mien.errors import UserError
from mien.media.colors import HLG, srgb_signal
from mien.media.video import count_frames, probe_video, read_sound, read_video_frames, write_video
from mien.pipeline import drive as driving
from test_capture_parts import streak
from test_changing_pictures import flagged, write, write_single_fields

pytestmark = pytest.mark.unchecked
Face = Callable[..., np.ndarray]
"""`face_picture` of the test data: takes a side and a margin in pixels."""


@dataclass(frozen=True)
class Odd:
    """A video and what is right for it."""

    write: Callable[[Path, Face], Path]
    """Writes the video into a folder and returns its path."""
    said: tuple[str, ...] = ()
    """Patterns of all lines besides the usual ones, in order."""
    report: dict[str, Any] = field(default_factory=dict)
    """Entries of report.json."""
    options: tuple[str, ...] = ()
    check: Callable[[Capture, Face], object] = lambda capture, face: None
    """Asserts what is in the capture."""


def wide(face: Face) -> np.ndarray:
    return np.pad(face(160), ((20, 20), (40, 40), (0, 0)), mode="edge")


def filmed(change: Callable[[np.ndarray], Sequence[np.ndarray]], folder: Path, face: Face) -> Path:
    write_video(folder / "clip.mp4", iter(change(wide(face))), 25.0, crf=10)
    return folder / "clip.mp4"


def brighter(gain: float, picture: np.ndarray) -> list[np.ndarray]:
    return [np.clip(picture.astype(np.float32) * gain, 0, 255).astype(np.uint8)] * 4


def in_green_light(picture: np.ndarray) -> list[np.ndarray]:
    light = np.clip(light_of(picture.astype(np.float64)) * np.array((0.3, 1.0, 0.4)), 0, 1)
    return [np.rint(255 * srgb_signal(light)).astype(np.uint8)] * 4


def expect_unusable(capture: Capture, face: Face) -> None:
    assert capture.valid.all()
    assert np.flatnonzero(~capture.usable[:, 0]).tolist() == [6, 7]


AGAIN = "warning: clip: the face is {}.*record the video again"
CAST = "warning: clip: the skin is green \\(red .*white balance"
PLAIN = {"dark": False, "overexposed": False, "color_cast": None, "frames_blurred": 0, "combs": False}


def woven_heads(face: Face) -> list[np.ndarray]:
    """Return frames of a head that moves by five pixels from field to field."""
    fields = []
    for index in range(12):
        picture = np.full((240, 320, 3), 190, np.uint8)
        picture[20:220, 20 + 5 * index : 220 + 5 * index] = face(200)
        fields.append(picture)
    frames = [picture.copy() for picture in fields[::2]]
    for frame, second in zip(frames, fields[1::2], strict=True):
        frame[1::2] = second[1::2]
    return frames


def woven(kind: str, mark: str, folder: Path, face: Face) -> Path:
    """Write frames of two fields, which the file marks as that or not."""
    path = folder / f"clip.{kind.partition('.')[2]}"
    write(path, kind, flagged(woven_heads(face), "yuv420p", [mark] * 6))
    return path


def segmented(folder: Path, face: Face) -> Path:
    """Write a progressive video that is marked as interlaced (PsF)."""
    frames = [woven_heads(face)[0][::2].repeat(2, axis=0)] * 4
    write(folder / "clip.mp4", "h264.mp4", flagged(frames, "yuv420p", ["tff"] * 4))
    return folder / "clip.mp4"


def fields_of_hevc(folder: Path, face: Face) -> Path:
    write_single_fields(folder / "clip.mp4", [wide(face)] * 4)
    return folder / "clip.mp4"


PROGRESSIVE = "no combs: if filmed progressively, --capture.deinterlace never keeps more detail"
UNMARKED = "warning:.*not marked as interlaced; if moving edges look like combs, add --capture.deinterlace always"
DEINTERLACED = "clip.m..: interlaced; 6 of 6 frames are deinterlaced, each to one picture$"
WHOLE = ("--capture.crop", "none")
NEVER, ALWAYS = ((*WHOLE, "--capture.deinterlace", mode) for mode in ("never", "always"))


TICKS = [0, 33, 66, 166, 200, 233]


def variable(folder: Path, face: Face) -> Path:
    planes = to_planes(face(160) / 255, BT709, 8)
    write_planes(folder / "clip.mkv", [planes] * len(TICKS), "yuv444p", ticks=TICKS)
    return folder / "clip.mkv"


def expect_times(capture: Capture, face: Face) -> None:
    np.testing.assert_allclose(capture.timestamps, np.array(TICKS) / 1000, atol=1e-6)
    assert capture.fps == pytest.approx(4 / 0.133), "the rate of the usual frames"


def odd_size(folder: Path, face: Face) -> Path:
    picture = np.full((121, 163, 3), 190, np.uint8)
    picture[:, 21:142] = cv2.resize(face(160), (121, 121), interpolation=cv2.INTER_AREA)
    write_planes(folder / "clip.mkv", [to_planes(picture / 255, BT709, 8)] * 3, "yuv444p")
    return folder / "clip.mkv"


def expect_size(height: int, width: int, capture: Capture, face: Face) -> None:
    assert capture.images.shape == (3, 1, height, width, 3)
    assert capture.valid.all()


def large(folder: Path, face: Face) -> Path:
    """Write pictures of 4K with a head aside."""
    picture = np.full((2160, 3840, 3), 190, np.uint8)
    picture[500:1700, 1900:3100] = cv2.resize(face(400), (1200, 1200))
    write_video(folder / "clip.mp4", [picture] * 2, 25.0, preset="ultrafast")
    return folder / "clip.mp4"


def expect_the_head(capture: Capture, face: Face) -> None:
    assert capture.valid.all()
    assert capture.images.shape[2:4] == (256, 256)
    crop = capture.source["crop"]
    nose = capture.landmarks[0, 0, 1] * crop["width"] / 256 + [crop["left"], crop["top"]]
    np.testing.assert_allclose(nose, [2500, 500 + 0.42 * 1200], atol=45)


MOMENTS = [0, 20, 40, 50, 90, 110, 130, 150]


def upright(face: Face) -> np.ndarray:
    return np.pad(face(160), ((70, 90), (10, 10), (0, 0)), mode="edge")


def of_a_telephone(folder: Path, face: Face) -> Path:
    """Write HEVC with ten bits, HLG, a rotation flag and a variable rate, in a .mov."""
    stored = np.ascontiguousarray(np.rot90(upright(face), 3))
    luma, *chroma = to_planes(hdr_signal(light_of(stored), HLG), BT2020, 10)
    small = [cv2.resize(plane, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for plane in chroma]

    def prepare(stream: av.VideoStream) -> None:
        stream.codec_tag = "hvc1"
        stream.set_display_rotation(90)

    encode(
        folder / "clip.mov", [[luma, *small]] * 8, "libx265", "yuv420p10le", rate=600, colors=(9, 9, HLG, 1),
        options={"x265-params": "log-level=none:crf=10"}, ticks=MOMENTS, prepare=prepare,
    )  # fmt: skip
    return folder / "clip.mov"


def expect_a_telephone(capture: Capture, face: Face) -> None:
    picture = upright(face)
    assert capture.images.shape == (8, 1, *picture.shape)
    assert capture.valid.all()
    np.testing.assert_allclose(capture.timestamps, np.array(MOMENTS) / 600, atol=1e-4)
    # Highlights are compressed; darker colours are restored.
    ordinary = picture.max(axis=-1) < 200
    assert np.abs(capture.images[4, 0].astype(int) - picture)[ordinary].mean() < 3


FIELDS = partial(woven, "h264.mp4", "tff")
ODD = {
    "plain": Odd(partial(filmed, lambda picture: [picture] * 4), report=PLAIN),
    "dark": Odd(partial(filmed, partial(brighter, 0.2)), (AGAIN.format("dark"),), {**PLAIN, "dark": True}),
    "over-exposed": Odd(
        partial(filmed, partial(brighter, 1.4)), (AGAIN.format("over-exposed"),), {**PLAIN, "overexposed": True}),
    "green light": Odd(partial(filmed, in_green_light), (CAST,), {"color_cast": "green"}),
    "blurred": Odd(
        partial(filmed, lambda one: [one] * 6 + [streak(one, 0.07 * 0.46 * 160, 0.0)] * 2 + [one] * 4),
        ("the face is blurred in 2 of 12 frames",), {"blurred_frames": [6, 7]},
        check=expect_unusable),
    "interlaced": Odd(FIELDS, (DEINTERLACED,), {"frames_deinterlaced": 6, "combs": True}, WHOLE),
    "interlaced, kept": Odd(FIELDS, (), {"frames_deinterlaced": 0, "combs": True}, NEVER),
    "marked as interlaced": Odd(segmented, (PROGRESSIVE,), {"frames_deinterlaced": 4, "combs": False}, WHOLE),
    "not marked": Odd(partial(woven, "ffv1.mkv", "prog"), (UNMARKED,), {"frames_deinterlaced": 0}, WHOLE),
    "not marked, but told": Odd(
        partial(woven, "ffv1.mkv", "prog"), (DEINTERLACED,), {"frames_deinterlaced": 6}, ALWAYS),
    "fields of HEVC": Odd(fields_of_hevc, ("warning:.*each picture is a single field",), {}, WHOLE),
    "variable rate": Odd(variable, (r"33 to 100 ms apart \(variable rate\)",), check=expect_times),
    "odd size": Odd(odd_size, options=WHOLE, check=partial(expect_size, 121, 163)),
    "odd size, smaller": Odd(odd_size, (), {}, (*WHOLE, "--capture.size", "77"), partial(expect_size, 57, 77)),
    "4K": Odd(large, (), {}, ("--capture.size", "256"), expect_the_head),
    "a telephone": Odd(
        of_a_telephone,
        (r"^(?!warning).*HDR video \(HLG\); its pictures are tone-mapped",
         r"^(?!warning).*\(variable rate\); all are kept, each with its own time"),
        {"hdr": "HLG"}, WHOLE, expect_a_telephone),
}  # fmt: skip


@pytest.mark.parametrize("kind", ODD)
def test_what_is_said_of_odd_footage(kind: str, test_data: Path, tmp_path: Path, capsys) -> None:
    odd, face, out = ODD[kind], partial(face_picture, test_data), tmp_path / "out"
    words = ["capture", str(odd.write(tmp_path, face)), "--out", str(out), "--capture.no-cuts", *odd.options]
    assert main(words) == 0
    usual = r"find the face in |capture clip: |clip: \d+ frames of .* (take about|a face in) "
    remarks = [line for line in capsys.readouterr().err.splitlines() if line and not re.match(usual, line)]
    assert len(remarks) == len(odd.said), remarks
    for remark, pattern in zip(remarks, odd.said, strict=True):
        assert re.search(pattern, remark), remark
    folder = out / "sequences/clip/capture"
    report = json.loads((folder / "report.json").read_text())
    assert {name: report[name] for name in odd.report} == odd.report
    hints = [remark.removeprefix("warning: clip: ") for remark in remarks if remark.startswith("warning: clip: ")]
    assert report["hints"] == hints
    odd.check(read_capture(folder), face)


Track = tuple[int, int, bool]
"""Side in pixels, number of frames, and whether the file marks it as default."""

FILES: dict[str, tuple[list[Track], int]] = {
    "a thumbnail first": ([(120, 1, False), (64, 6, False)], 1),
    "a thumbnail that is the default": ([(120, 1, True), (64, 6, False)], 1),
    "the default is smaller": ([(128, 6, False), (64, 6, True)], 1),
    "the largest of two defaults": ([(64, 6, True), (128, 6, True)], 1),
    "the largest": ([(64, 6, False), (128, 6, False), (96, 6, False)], 1),
    "equal ones": ([(64, 6, False), (64, 6, False)], 0),
    "one frame is all": ([(64, 1, False)], 0),
}


def write_tracks(path: Path, tracks: list[tuple[list[np.ndarray], bool]], rates: tuple[int, ...] = ()) -> None:
    """Write a file with a stream for each list of pictures [h, w, 3], or of samples [1, n]."""
    with av.open(str(path), "w") as container:
        streams = []
        for (contents, is_default), rate in zip(tracks, rates or [25] * len(tracks), strict=True):
            if contents[0].ndim == 3:
                stream = container.add_stream("mpeg4", rate=rate, options={"qscale": "2"})
                stream.height, stream.width, stream.pix_fmt = *contents[0].shape[:2], "yuv420p"
            else:
                stream = container.add_stream("pcm_s16le", rate=rate, layout="mono")
            stream.disposition = Disposition.default if is_default else Disposition(0)
            streams.append((stream, [_frame(content, rate) for content in contents]))
        packets = [packet for stream, frames in streams for frame in [*frames, None] for packet in stream.encode(frame)]
        container.mux(packets)


def _frame(content: np.ndarray, rate: int) -> av.VideoFrame | av.AudioFrame:
    if content.ndim == 3:
        return av.VideoFrame.from_ndarray(content, format="rgb24")
    frame = av.AudioFrame.from_ndarray(content, format="s16", layout="mono")
    frame.sample_rate = rate
    return frame


def flat(side: int, level: int = 100) -> np.ndarray:
    return np.full((side, side, 3), level, np.uint8)


# Writers of .mp4 mark the first stream if none is marked.
@pytest.mark.parametrize(
    ("name", "ending"),
    [*((name, "mkv") for name in FILES), ("a thumbnail first", "mp4"), ("the default is smaller", "mov")],
)
def test_the_video_is_found_among_streams(name: str, ending: str, tmp_path: Path) -> None:
    tracks, expected = FILES[name]
    path = tmp_path / f"a.{ending}"
    write_tracks(path, [([flat(side)] * frames, is_default) for side, frames, is_default in tracks])
    side, frames, _ = tracks[expected]
    info = probe_video(path)
    assert (info.stream, sorted(info.other_streams)) == (expected, [i for i in range(len(tracks)) if i != expected])
    assert count_frames(path) == frames
    assert [picture.shape for _, picture in read_video_frames(path)] == [(side, side, 3)] * frames


def test_the_default_stream_counts_for_sound_too_and_thousands_of_frames_a_second_are_no_film(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_tracks(path, [([flat(128)] * 5, False), ([flat(64)] * 5, False)], (5000, 25))
    assert probe_video(path).stream == 1
    path, silence = tmp_path / "a.mkv", np.zeros((1, 800), np.int16)
    write_tracks(path, [([silence] * 3, False), ([silence + 8000] * 3, True)], (16000, 16000))
    assert read_sound(path).mean() == pytest.approx(8000 / 32768, abs=1e-3)


def test_a_webcam_behind_a_screen_recording_is_named_and_can_be_chosen(
    test_data, tmp_path, capsys, monkeypatch
) -> None:
    path, face = tmp_path / "call.mkv", face_picture(test_data)
    write_tracks(path, [([flat(256)] * 4, False), ([face] * 4, False)])
    command = ["capture", str(path), "--out", str(tmp_path / "out"), "--capture.crop", "none"]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert "stream 0 is captured, and --capture.stream chooses another (1)" in said
    assert said.strip().endswith("no face found in any of its 4 frames; stream 1 of the file shows one: add "
                                 "--capture.stream 1")  # fmt: skip
    assert main([*command, "--capture.stream", "1"]) == 0
    capture = read_capture(tmp_path / "out" / "sequences" / "call" / "capture")
    assert (capture.timesteps, capture.width) == (4, 160)
    with pytest.raises(UserError, match=r"stream 2 is no stream of pictures; .* 0 \(256x256\), 1 \(160x160\)"):
        capture_video(path, tmp_path / "none", CaptureSettings(stream=2))
    # As a driver, the film has a workspace for each way to capture it.
    monkeypatch.setattr(driving, "run_tracking_stage", lambda workspace, *_, **__: workspace.sequence_names())
    monkeypatch.setenv("MIEN_CACHE", str(tmp_path / "cache"))
    with pytest.raises(UserError, match="add --capture.stream 1$"):
        driving.tracked_film(path, "anny")
    workspace, names = driving.tracked_film(path, "anny", CaptureSettings(crop="none", stream=1))
    assert [read_capture(workspace.sequence_dir(name) / "capture").width for name in names] == [160]
