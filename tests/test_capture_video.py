"""Video files are read and written with their times and colours, by the header or the tags of the container."""

import os
import wave
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from capture_helpers import BT2020, encode, hdr_signal, light_of, to_planes, write_gradient_video, write_planes
from mien.media.colors import HLG, PQ, Colors, roll_off, srgb_signal
from mien.media.video import count_frames, probe_video, read_video_frames, write_video
from refusals import refuses

COLORS = np.array([[200, 120, 100], [90, 60, 50], [40, 90, 60], [20, 30, 120], [128, 128, 128], [0, 0, 0]])
"""Colours of sRGB below the knee, like those of faces."""


def test_written_frames_are_read_back(tmp_path):
    path = tmp_path / "clip.mp4"
    pictures = write_gradient_video(path, frames=5, width=64, height=48, fps=29.97)
    times, frames = zip(*read_video_frames(path), strict=True)
    np.testing.assert_allclose(times, np.arange(5) / 29.97, atol=1e-9)
    # Chroma has half the resolution, which costs a smooth picture about two levels on average.
    assert np.abs(np.stack(frames).astype(int) - pictures).mean() < 2
    info = probe_video(path)
    assert info.frames == count_frames(path) == 5
    assert info.fps == pytest.approx(29.97, abs=1e-4)
    assert {frame.shape for _, frame in read_video_frames(path, longest_side=32)} == {(24, 32, 3)}
    # Wrong matrices or ranges shift whole colours, which a mean over a picture would hide. Odd sizes are padded.
    for color in ((200, 30, 40), (30, 180, 60), (20, 60, 220), (128, 128, 128), (255, 255, 255), (0, 0, 0)):
        write_video(path, [np.full((33, 41, 3), color, np.uint8)] * 2, 25, crf=1)
        _, frame = next(read_video_frames(path))
        assert frame.shape == (34, 42, 3)
        assert np.abs(frame.astype(int) - color).max() <= 3, color


def test_equal_pictures_give_equal_files(tmp_path):
    """The encoder may not depend on what lies in memory that it has not written."""
    random = np.random.default_rng(0)
    disc = np.hypot(*np.mgrid[-1:1:80j, -1:1:80j]) < 0.7
    picture = np.where(disc[..., None], random.integers(80, 200, (80, 80, 3)), 255).astype(np.uint8)
    moved, path, files = np.roll(picture, 1, 1), tmp_path / "clip.mp4", set()
    for _ in range(8):
        litter = [random.random(size) for size in random.integers(1, 100_000, 50)]
        write_video(path, [picture, moved, moved, picture, picture, picture], 25)
        files.add(path.read_bytes())
        del litter
    assert len(files) == 1


@pytest.mark.parametrize(("degrees", "mirrored", "turn"), [
    (90, False, lambda picture: np.rot90(picture, 1)), (-90, False, lambda picture: np.rot90(picture, -1)),
    (180, False, lambda picture: np.rot90(picture, 2)), (0, True, lambda picture: picture[:, ::-1]),
    (90, True, lambda picture: np.rot90(picture, 1)[:, ::-1]),
])  # fmt: skip
def test_rotation_and_mirror_flags_are_applied(tmp_path, degrees, mirrored, turn):
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:24, :20] = 255
    encode(tmp_path / "turned.mp4", [picture], prepare=lambda stream: stream.set_display_rotation(degrees, mirrored))
    _, frame = next(read_video_frames(tmp_path / "turned.mp4"))
    assert frame.shape == turn(picture).shape
    assert np.abs(frame.astype(int) - turn(picture)).mean() < 4


@pytest.mark.parametrize(("aspect", "size"), [(Fraction(2, 1), (48, 128)), (Fraction(3, 4), (64, 64))])
def test_pixels_become_square(tmp_path, aspect, size):
    picture = np.full((48, 64, 3), 90, np.uint8)
    picture[12:32, 20:40] = 235
    encode(tmp_path / "a.mp4", [picture], prepare=lambda stream: setattr(stream, "sample_aspect_ratio", aspect))
    _, shown = next(read_video_frames(tmp_path / "a.mp4"))
    assert shown.shape[:2] == size
    bright = shown[..., 1] > 160
    assert bright.any(axis=0).sum() / bright.any(axis=1).sum() == pytest.approx(float(aspect), rel=0.08)


def test_bad_videos_are_named_and_nothing_is_written_of_nothing_or_nowhere(tmp_path):
    (tmp_path / "text.mp4").write_text("this is no video " * 100)
    (tmp_path / "empty.mp4").touch()
    write_gradient_video(tmp_path / "half.mp4")
    os.truncate(tmp_path / "half.mp4", (tmp_path / "half.mp4").stat().st_size // 2)
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(bytes(1600))
    for name, message in (
        ("text.mp4", "cannot be read as a video"), ("empty.mp4", "is empty"),
        ("half.mp4", "cannot be read as a video .* incomplete[?] copy it again"),
        ("sound.wav", "no video stream"), ("missing.mp4", "no such file"), (".", "is not a file"),
    ):  # fmt: skip
        error = refuses(message, next, read_video_frames(tmp_path / name))
        assert str(tmp_path / name) in error
    before = sorted(tmp_path.iterdir())
    refuses("no frames", write_video, tmp_path / "none.mp4", [], 25)
    assert sorted(tmp_path.iterdir()) == before
    blocked = tmp_path / "file"
    blocked.touch()
    refuses("cannot be written", write_video, blocked / "clip.mp4", [np.zeros((16, 16, 3), np.uint8)], 25)


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_hdr_comes_back_as_the_colors_it_was_made_of(tmp_path, transfer):
    path = tmp_path / "hdr.mkv"
    signal = np.repeat(np.repeat(hdr_signal(light_of(COLORS), transfer)[None], 8, axis=0), 8, axis=1)
    write_planes(path, [to_planes(signal, BT2020, 10)], "yuv444p10le", (9, 9, transfer, 1))
    assert probe_video(path).hdr == {PQ: "PQ", HLG: "HLG"}[transfer]
    _, picture = next(read_video_frames(path))
    found = picture[4, 4::8].astype(int)
    assert np.abs(found - COLORS).max() <= 3, found


def test_hdr_highlights_are_pressed_together_without_a_step(tmp_path):
    path = tmp_path / "bright.mkv"
    levels = np.linspace(0, 1200 / 203, 200)
    signal = hdr_signal(np.repeat(levels[:, None], 3, axis=1), PQ)
    write_planes(path, [to_planes(np.repeat(signal[None], 4, axis=0), BT2020, 10)], "yuv444p10le", (9, 9, PQ, 1))
    gray = next(read_video_frames(path))[1][1].astype(int)
    assert np.ptp(gray, axis=1).max() <= 2  # grey stays grey
    assert (np.diff(gray[:, 1]) >= 0).all()
    assert 230 <= gray[np.searchsorted(levels, 1.0), 1] <= 245  # diffuse white
    assert (gray[levels >= 1000 / 203, 1] == 255).all()
    np.testing.assert_allclose(roll_off(np.array([0.75, 1000 / 203, 50.0])), [0.75, 1, 1])
    np.testing.assert_allclose(np.diff(roll_off(np.array([0.75, 0.7501]))), 1e-4, rtol=1e-3)


def test_ten_bits_are_rounded_exactly(tmp_path):
    path = tmp_path / "ramp.mkv"
    ramp = np.tile(np.arange(64, 941, dtype=np.uint16), (4, 1))
    gray = np.full_like(ramp, 512)
    write_planes(path, [np.stack([ramp, gray, gray])], "yuv444p10le")
    _, picture = next(read_video_frames(path))
    exact = (ramp[0].astype(float) - 64) * 255 / 876
    assert np.abs(picture[0] - exact[:, None]).max() <= 0.51


COLOR = np.array([200, 120, 100])
WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""Weights of red and blue in luma, by the code of the matrix."""
SILENT = Colors()
LIMITED, FULL = 1, 2
KINDS = {
    "prores.mov": ("prores_ks", "yuv422p10le", {}), "prores.mkv": ("prores_ks", "yuv422p10le", {}),
    "h264.mov": ("libx264", "yuv420p", {"crf": "1"}), "h264.mp4": ("libx264", "yuv420p", {"crf": "1"}),
    "hevc.mp4": ("libx265", "yuv420p10le", {"x265-params": "log-level=none:crf=1"}),
    "hevc.mkv": ("libx265", "yuv420p10le", {"x265-params": "log-level=none:crf=1"}),
    "vp9.webm": ("libvpx-vp9", "yuv420p", {"crf": "1", "b": "0"}),
    "vp9.mp4": ("libvpx-vp9", "yuv420p", {"crf": "1", "b": "0"}), "ffv1.mkv": ("ffv1", "yuv422p10le", {}),
}  # fmt: skip


def numbers_of(colors: Colors, bits: int) -> list[int]:
    """Return Y', Cb and Cr of `COLOR` in these colours."""
    signal = COLOR / 255
    if colors.transfer in (PQ, HLG):
        signal = hdr_signal(light_of(COLOR[None]), colors.transfer)[0]
    red, blue = WEIGHTS[colors.matrix]
    luma = float(signal @ [red, 1 - red - blue, blue])
    chroma = [(signal[2] - luma) / (2 - 2 * blue), (signal[0] - luma) / (2 - 2 * red)]
    unit = 1 << (bits - 8)
    if colors.range == FULL:
        most = 256 * unit - 1
        return [round(most * luma), *(round(128 * unit + most * value) for value in chroma)]
    return [round(16 * unit + 219 * unit * luma), *(round(128 * unit + 224 * unit * value) for value in chroma)]


def write_color(path: Path, kind: str, true: Colors, header: Colors, container: Colors, height: int = 96) -> None:
    """Write three frames of `COLOR` in the colours `true`, whose header and container state something else."""
    codec, pixels, options = KINDS[kind]
    bits, halves = 10 if pixels.endswith("10le") else 8, (height // 2 if "420" in pixels else height, 48)
    planes = [
        np.full(size, value, np.uint16 if bits == 10 else np.uint8)
        for size, value in zip(((height, 96), halves, halves), numbers_of(true, bits), strict=True)
    ]
    # The codes of primaries are those of the matrices.
    stated = [(colors.matrix, colors.matrix, colors.transfer, colors.range) for colors in (header, container)]
    encode(path, [planes] * 3, codec, pixels, options=options, colors=stated[0], tags=stated[1])


def error_of(path: Path) -> float:
    """Return the largest error of a level in the first picture."""
    _, picture = next(read_video_frames(path))
    return float(np.abs(picture.reshape(-1, 3).mean(axis=0) - COLOR).max())


def check(path: Path, true: Colors, header: Colors, container: Colors, height: int = 96, hdr: str = "") -> None:
    write_color(path, path.name, true, header, container, height)
    assert probe_video(path).hdr == hdr
    assert error_of(path) <= 4


@pytest.mark.parametrize("kind", KINDS)
def test_tags_of_the_container_count_where_the_header_is_silent(kind, tmp_path):
    for transfer, matrix, height in ((HLG, 9, 96), (PQ, 9, 96), (1, 1, 96), (6, 5, 720), (6, 6, 720)):
        if (transfer, matrix) in ((HLG, 9), (6, 5)) or kind in ("prores.mov", "hevc.mp4", "vp9.webm"):
            true = Colors(transfer, matrix, LIMITED)
            check(tmp_path / kind, true, SILENT, true, height=height, hdr={PQ: "PQ", HLG: "HLG"}.get(transfer, ""))
    for matrix, height in ((6, 96), (1, 720)):
        if height == 96 or kind in ("prores.mov", "vp9.webm"):
            check(tmp_path / kind, Colors(1, matrix, LIMITED), SILENT, SILENT, height=height)
        if kind.endswith((".mkv", ".webm")):  # HDR has the matrix of BT.2020
            hlg = Colors(HLG, 9, LIMITED), SILENT, Colors(HLG, 2, LIMITED)
            check(tmp_path / kind, *hlg, height=height, hdr="HLG")


@pytest.mark.parametrize("kind", ["hevc.mp4", "hevc.mkv", "vp9.webm", "vp9.mp4", "h264.mp4", "ffv1.mkv", "prores.mkv"])
def test_full_range_of_the_container_counts(kind, tmp_path):
    check(tmp_path / kind, Colors(1, 1, FULL), SILENT, Colors(1, 1, FULL))
    if not kind.endswith(".mp4"):  # FFmpeg writes no colours into .mov and .mp4 unless the matrix is among them
        check(tmp_path / kind, Colors(1, 6, FULL), SILENT, Colors(2, 2, FULL))


@pytest.mark.parametrize("kind", KINDS)
def test_the_header_counts_before_the_container(kind, tmp_path):
    true, other = Colors(HLG, 9, LIMITED), Colors(1, 1, LIMITED)
    if KINDS[kind][0] in ("libx264", "libx265", "prores_ks"):
        check(tmp_path / kind, true, true, other, hdr="HLG")
    else:  # FFV1 and VP9 have no transfer function in their header
        write_color(tmp_path / kind, kind, true, true, other)
        assert probe_video(tmp_path / kind).hdr == ""


def test_zeros_in_the_header_of_prores_are_unknown(tmp_path):
    """ProRes writes 0 for unknown. FFmpeg takes a matrix of 0 as RGB."""
    path = tmp_path / "prores.mov"
    true = Colors(1, 1, LIMITED)
    write_color(path, "prores.mov", true, SILENT, true)
    data = path.read_bytes()
    assert data.count(b"icpf") == 3
    for place in (start for start in range(len(data)) if data.startswith(b"icpf", start)):
        # The frame's header begins after `icpf`: two bytes of length, then twelve to the three codes of colours.
        at = place + 4 + 14
        assert data[at : at + 3] == b"\x02\x02\x02"
        data = data[:at] + bytes(3) + data[at + 3 :]
    path.write_bytes(data)
    assert error_of(path) <= 4


BT2020_OF_BT709 = [[0.627404, 0.329283, 0.043313], [0.069097, 0.919540, 0.011362], [0.016391, 0.088013, 0.895595]]
P3_OF_BT709 = [[0.822462, 0.177538, 0.0], [0.033194, 0.966806, 0.0], [0.017083, 0.072397, 0.910520]]


@pytest.mark.parametrize("kind", ["h264.mp4", "prores.mov", "vp9.webm"])
@pytest.mark.parametrize(
    ("primaries", "matrix", "transfer", "convert"),
    [(9, 9, 14, BT2020_OF_BT709), (9, 1, 1, BT2020_OF_BT709), (12, 1, 13, P3_OF_BT709), (1, 1, 1, np.eye(3))],
    ids=["BT.2020", "BT.2020 with another matrix", "P3", "BT.709"],
)
def test_wide_primaries_are_converted(kind, primaries, matrix, transfer, convert, tmp_path):
    """Cameras and screen recorders write them without HDR. Skin is pale and greenish without conversion."""
    codec, pixels, options = KINDS[kind]
    wide = srgb_signal(np.maximum(light_of(COLOR) @ np.array(convert).T, 0))
    bits = 10 if pixels.endswith("10le") else 8
    y, blue, red = to_planes(np.broadcast_to(wide, (96, 96, 3)), (WEIGHTS[matrix][0], WEIGHTS[matrix][1]), bits)
    step = 2 if "420" in pixels else 1
    planes = [y, blue[::step, ::2], red[::step, ::2]]
    encode(tmp_path / kind, [planes] * 3, codec, pixels, options=options, colors=(matrix, primaries, transfer, LIMITED))
    assert error_of(tmp_path / kind) <= 4
