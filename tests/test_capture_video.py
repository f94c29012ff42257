"""Video files are read and written with their colours and times."""

import av
import numpy as np
import pytest

from capture_helpers import write_gradient_video
from mien.capture.video import probe_video, read_video_frames, write_video
from mien.errors import UserError


def test_written_frames_are_read_back(tmp_path):
    path = tmp_path / "clip.mp4"
    pictures = write_gradient_video(path, frames=5, width=64, height=48, fps=29.97)
    times, frames = zip(*read_video_frames(path), strict=True)
    np.testing.assert_allclose(times, np.arange(5) / 29.97, atol=1e-9)
    # Chroma has half the resolution, which costs a smooth picture about two levels on average.
    assert np.abs(np.stack(frames).astype(int) - pictures).mean() < 2
    info = probe_video(path)
    assert info.frames == 5
    assert info.fps == pytest.approx(29.97, abs=1e-4)


def test_colors_keep_their_level(tmp_path):
    """Colours keep their level.

    Wrong matrices or ranges shift whole colours, which a mean over a picture would hide.
    """
    colors = np.array([[200, 30, 40], [30, 180, 60], [20, 60, 220], [128, 128, 128], [255, 255, 255], [0, 0, 0]])
    for color in colors.astype(np.uint8):
        path = tmp_path / "color.mp4"
        write_video(path, [np.broadcast_to(color, (32, 32, 3)).copy()] * 2, 25, crf=1)
        _, frame = next(read_video_frames(path))
        assert np.abs(frame.astype(int) - color).max() <= 3, color


def test_equal_pictures_give_equal_files(tmp_path):
    """The encoder may not depend on what lies in memory that it has not written."""
    random = np.random.default_rng(0)
    disc = np.hypot(*np.mgrid[-1:1:80j, -1:1:80j]) < 0.7
    picture = np.where(disc[..., None], random.integers(80, 200, (80, 80, 3)), 255).astype(np.uint8)
    moved, path, files = np.roll(picture, 1, 1), tmp_path / "clip.mp4", set()
    for _ in range(20):
        litter = [random.random(size) for size in random.integers(1, 100_000, 50)]
        write_video(path, [picture, moved, moved, picture, picture, picture], 25)
        files.add(path.read_bytes())
        del litter
    assert len(files) == 1


def test_odd_sizes_are_padded_by_the_border(tmp_path):
    path = tmp_path / "odd.mp4"
    picture = np.full((33, 41, 3), 90, np.uint8)
    write_video(path, [picture], 25)
    _, frame = next(read_video_frames(path))
    assert frame.shape == (34, 42, 3)
    assert np.abs(frame.astype(int) - 90).max() <= 2


@pytest.mark.parametrize(
    ("degrees", "mirrored", "turn"),
    [
        (90, False, lambda picture: np.rot90(picture, 1)),
        (-90, False, lambda picture: np.rot90(picture, -1)),
        (180, False, lambda picture: np.rot90(picture, 2)),
        (0, True, lambda picture: picture[:, ::-1]),
        (90, True, lambda picture: np.rot90(picture, 1)[:, ::-1]),
    ],
)
def test_rotation_and_mirror_flags_are_applied(tmp_path, degrees, mirrored, turn):
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24, :20] = 255
    path = tmp_path / "turned.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.set_display_rotation(degrees, mirrored)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    _, frame = next(read_video_frames(path))
    expected = turn(picture)
    assert frame.shape == expected.shape
    assert np.abs(frame.astype(int) - expected).mean() < 4


def test_shrinking_while_reading(tmp_path):
    """Frames are shrunk while they are read."""
    path = tmp_path / "clip.mp4"
    write_gradient_video(path, width=128, height=96)
    shapes = {frame.shape for _, frame in read_video_frames(path, longest_side=64)}
    assert shapes == {(48, 64, 3)}


def test_variable_frame_rate_keeps_its_times(tmp_path):
    path = tmp_path / "variable.mp4"
    ticks = [0, 40, 50, 130, 170]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=1000, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for tick in ticks:
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), tick, np.uint8), format="rgb24")
            frame.pts = tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    times = [seconds for seconds, _ in read_video_frames(path)]
    np.testing.assert_allclose(times, np.array(ticks) / 1000, atol=1e-6)


def test_bad_videos_are_named(tmp_path):
    text = tmp_path / "text.mp4"
    text.write_text("this is no video " * 100)
    empty = tmp_path / "empty.mp4"
    empty.touch()
    whole = tmp_path / "whole.mp4"
    write_gradient_video(whole)
    truncated = tmp_path / "truncated.mp4"
    truncated.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    sound = tmp_path / "sound.wav"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    cases = {
        text: "cannot be read as a video",
        empty: "is empty",
        truncated: "cannot be read as a video .* incomplete[?] copy it again",
        sound: "no video stream",
        tmp_path / "missing.mp4": "no such file",
        tmp_path: "is not a file",
    }
    for path, message in cases.items():
        with pytest.raises(UserError, match=message) as error:
            next(read_video_frames(path))
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)


def test_writing_nothing_or_nowhere_is_refused(tmp_path):
    with pytest.raises(UserError, match="no frames"):
        write_video(tmp_path / "none.mp4", [], 25)
    assert list(tmp_path.iterdir()) == []
    blocked = tmp_path / "file"
    blocked.touch()
    with pytest.raises(UserError, match="cannot be written"):
        write_video(blocked / "clip.mp4", [np.zeros((16, 16, 3), np.uint8)], 25)
