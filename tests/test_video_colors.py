"""Where the codec's header is silent about colours, the container's tags count, for the probe and for pictures."""

from pathlib import Path

import numpy as np
import pytest

from capture_helpers import encode, hdr_signal, light_of
from mien.capture.camera_names import CameraName
from mien.capture.colors import Colors
from mien.capture.live_camera import LiveCamera
from mien.capture.tone import HLG, PQ
from mien.capture.video import probe_video, read_video_frames

COLOR = np.array([200, 120, 100])
WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""Weights of red and blue in luma, by the code of the matrix."""
SILENT = Colors()
LIMITED, FULL = 1, 2
KINDS = {
    "prores.mov": ("prores_ks", "yuv422p10le", {}),
    "prores.mkv": ("prores_ks", "yuv422p10le", {}),
    "h264.mov": ("libx264", "yuv420p", {"crf": "1"}),
    "h264.mp4": ("libx264", "yuv420p", {"crf": "1"}),
    "hevc.mp4": ("libx265", "yuv420p10le", {"x265-params": "log-level=none:crf=1"}),
    "hevc.mkv": ("libx265", "yuv420p10le", {"x265-params": "log-level=none:crf=1"}),
    "vp9.webm": ("libvpx-vp9", "yuv420p", {"crf": "1", "b": "0"}),
    "vp9.mp4": ("libvpx-vp9", "yuv420p", {"crf": "1", "b": "0"}),
    "ffv1.mkv": ("ffv1", "yuv422p10le", {}),
}


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


def test_a_file_that_plays_as_a_camera_has_the_same_colors(tmp_path):
    path = tmp_path / "prores.mov"
    true = Colors(HLG, 9, LIMITED)
    write_color(path, "prores.mov", true, SILENT, true)
    with LiveCamera(CameraName(str(path), "v4l2"), again=False) as camera:
        camera.start()
        frame = camera.newest(-1, 120.0)
    assert frame is not None
    assert np.abs(frame.picture.reshape(-1, 3).mean(axis=0) - COLOR).max() <= 4
