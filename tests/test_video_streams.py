"""Of several streams in a file, every reader takes the one that is the video, and the user may choose another."""

from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from capture_helpers import face_picture
from mien.capture import CaptureSettings, capture_video, read_capture
from mien.capture.camera_names import CameraName
from mien.capture.live_camera import LiveCamera
from mien.capture.sound import read_sound
from mien.capture.video import count_frames, probe_video, read_video_frames
from mien.cli import main
from mien.errors import UserError

pytestmark = pytest.mark.unchecked
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
    with LiveCamera(CameraName(str(path), "v4l2"), again=False) as camera:
        camera.start()
        live = camera.newest(-1, 20.0)
    assert live is not None
    assert live.picture.shape == (side, side, 3)


def test_a_track_of_thousands_of_frames_a_second_is_no_film(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_tracks(path, [([flat(128)] * 5, False), ([flat(64)] * 5, False)], (5000, 25))
    assert probe_video(path).stream == 1


def test_sound_follows_the_default_too(tmp_path: Path) -> None:
    path, silence = tmp_path / "a.mkv", np.zeros((1, 800), np.int16)
    write_tracks(path, [([silence] * 3, False), ([silence + 8000] * 3, True)], (16000, 16000))
    assert read_sound(path).mean() == pytest.approx(8000 / 32768, abs=1e-3)


def test_a_webcam_behind_a_screen_recording_is_named_and_can_be_chosen(test_data, tmp_path, capsys) -> None:
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
