"""Videos of many kinds are captured: HDR, ten bits, pixel aspect, rotation, odd and large sizes, variable rate."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from capture_helpers import face_picture, to_planes, write_face_clip, write_planes
from mien.capture import CaptureSettings, capture_video, read_capture
from mien.capture.tone import HLG, PQ, hlg_scene_light, pq_light, roll_off
from mien.capture.video import count_frames, probe_video, read_video_frames
from mien.cli import main

BT2020, BT709 = (0.2627, 0.0593), (0.2126, 0.0722)
COLORS = np.array([[200, 120, 100], [90, 60, 50], [40, 90, 60], [20, 30, 120], [128, 128, 128], [0, 0, 0]])
"""Colours of sRGB below the knee, like those of faces."""


def inverse(curve, values, steps=200001):
    signal = np.linspace(0, 1, steps)
    return np.interp(values, curve(signal), signal)


def light_of(srgb):
    values = srgb / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def to_bt2020(light):
    matrix = [[0.627404, 0.329283, 0.043313], [0.069097, 0.919540, 0.011362], [0.016391, 0.088013, 0.895595]]
    return light @ np.array(matrix).T  # BT.2087


def hdr_signal(light, transfer):
    """Return the signal of display light (1 = 203 cd/m2, BT.2020)."""
    display = light * 203
    if transfer == PQ:
        return inverse(pq_light, display)
    luminance = display @ np.array([0.2627, 0.6780, 0.0593])
    scene = display / 1000 * np.power(np.maximum(luminance / 1000, 1e-9), 1 / 1.2 - 1)[..., None]
    return inverse(hlg_scene_light, scene)


@pytest.mark.parametrize("transfer", [PQ, HLG])
def test_hdr_comes_back_as_the_colors_it_was_made_of(tmp_path, transfer):
    path = tmp_path / "hdr.mkv"
    light = to_bt2020(light_of(COLORS))
    signal = np.repeat(np.repeat(hdr_signal(light, transfer)[None], 8, axis=0), 8, axis=1)
    write_planes(path, [to_planes(signal, BT2020, 10)], "yuv444p10le", (9, 9, transfer, 1))
    assert probe_video(path).hdr == {PQ: "PQ", HLG: "HLG"}[transfer]
    _, picture = next(read_video_frames(path))
    found = picture[4, 4::8].astype(int)
    assert np.abs(found - COLORS).max() <= 3, found


def test_hdr_highlights_are_pressed_together_without_a_step(tmp_path):
    path = tmp_path / "bright.mkv"
    levels = np.linspace(0, 1200 / 203, 200)
    signal = hdr_signal(to_bt2020(np.repeat(levels[:, None], 3, axis=1)), PQ)
    write_planes(path, [to_planes(np.repeat(signal[None], 4, axis=0), BT2020, 10)], "yuv444p10le", (9, 9, PQ, 1))
    gray = next(read_video_frames(path))[1][1].astype(int)
    assert np.ptp(gray, axis=1).max() <= 2  # grey stays grey
    assert (np.diff(gray[:, 1]) >= 0).all()
    assert 230 <= gray[np.searchsorted(levels, 1.0), 1] <= 245  # diffuse white
    assert (gray[levels >= 1000 / 203, 1] == 255).all()
    np.testing.assert_allclose(roll_off(np.array([0.75, 1000 / 203, 50.0])), [0.75, 1, 1])
    slope = np.diff(roll_off(np.array([0.75, 0.7501])))
    np.testing.assert_allclose(slope, 1e-4, rtol=1e-3)


def test_ten_bits_are_rounded_exactly(tmp_path):
    path = tmp_path / "ramp.mkv"
    ramp = np.tile(np.arange(64, 941, dtype=np.uint16), (4, 1))
    gray = np.full_like(ramp, 512)
    write_planes(path, [np.stack([ramp, gray, gray])], "yuv444p10le")
    _, picture = next(read_video_frames(path))
    exact = (ramp[0].astype(float) - 64) * 255 / 876
    assert np.abs(picture[0] - exact[:, None]).max() <= 0.51


def test_pixels_become_square(tmp_path):
    picture = np.full((48, 64, 3), 90, np.uint8)
    picture[12:32, 20:40] = 235
    for aspect, size in ((Fraction(2, 1), (48, 128)), (Fraction(3, 4), (64, 64))):
        path = tmp_path / f"{aspect.numerator}.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=25, options={"crf": "1"})
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            stream.sample_aspect_ratio = aspect
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
        _, shown = next(read_video_frames(path))
        assert shown.shape[:2] == size
        bright = shown[..., 1] > 160
        assert bright.any(axis=0).sum() / bright.any(axis=1).sum() == pytest.approx(float(aspect), rel=0.08)


def test_turned_clip_is_captured_upright(test_data, tmp_path):
    path = tmp_path / "turned.mp4"
    lying = np.ascontiguousarray(np.rot90(face_picture(test_data, 160, 16), -1))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = 192, 192, "yuv420p"
        stream.set_display_rotation(90)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(lying, format="rgb24")))
        container.mux(stream.encode())
    capture = capture_video(path, tmp_path / "capture")
    assert capture.valid.all()
    forehead, chin = capture.landmarks[0, 0, 10], capture.landmarks[0, 0, 152]
    assert chin[1] - forehead[1] > 60
    assert abs(chin[0] - forehead[0]) < 15


def test_odd_sizes_are_captured(test_data, tmp_path):
    path = tmp_path / "odd.mkv"
    picture = np.full((121, 163, 3), 190, np.uint8)
    picture[:, 21:142] = cv2.resize(face_picture(test_data), (121, 121), interpolation=cv2.INTER_AREA)
    write_planes(path, [to_planes(picture / 255, BT709, 8)] * 3, "yuv444p")
    capture = capture_video(path, tmp_path / "capture", CaptureSettings(crop="none"))
    assert capture.images.shape == (3, 1, 121, 163, 3)
    assert capture.valid.all()
    smaller = capture_video(path, tmp_path / "small", CaptureSettings(crop="none", size=77))
    assert smaller.images.shape == (3, 1, 57, 77, 3)
    assert smaller.valid.all()


def test_the_head_is_cut_out_of_4k(test_data, tmp_path):
    path = tmp_path / "4k.mkv"
    picture = np.full((2160, 3840, 3), 190, np.uint8)
    picture[700:1500, 2200:3000] = cv2.resize(face_picture(test_data, 400), (800, 800))
    write_planes(path, [to_planes(picture / 255, BT709, 8)] * 2, "yuv444p")
    capture = capture_video(path, tmp_path / "capture", CaptureSettings(size=256))
    assert capture.valid.all()
    assert capture.images.shape[2:4] == (256, 256)
    crop = capture.source["crop"]
    nose = capture.landmarks[0, 0, 1] * crop["width"] / 256 + [crop["left"], crop["top"]]
    np.testing.assert_allclose(nose, [2600, 700 + 0.42 * 800], atol=30)


def test_variable_rate_keeps_frames_and_times(test_data, tmp_path, capsys):
    path = tmp_path / "variable.mkv"
    ticks = [0, 33, 66, 166, 200, 233]
    planes = to_planes(face_picture(test_data) / 255, BT709, 8)
    write_planes(path, [planes] * len(ticks), "yuv444p", ticks=ticks)
    capture = capture_video(path, tmp_path / "capture")
    np.testing.assert_allclose(capture.timestamps, np.array(ticks) / 1000, atol=1e-6)
    assert capture.fps == pytest.approx(4 / 0.133), "the rate of the usual frames"
    assert "33 to 100 ms apart (variable rate)" in capsys.readouterr().err


def test_frames_are_counted_without_decoding(test_data, tmp_path):
    path = tmp_path / "clip.mp4"
    write_face_clip(path, test_data, frames=7)
    assert count_frames(path) == 7


def test_a_clip_of_a_telephone_is_captured(test_data, tmp_path, capsys):
    """A telephone's clip is captured: HEVC, ten bits, HLG, a rotation flag, a variable rate, in a .mov."""
    path = tmp_path / "IMG_0001.mov"
    upright = np.pad(face_picture(test_data, 160), ((70, 90), (10, 10), (0, 0)), mode="edge")
    stored = np.ascontiguousarray(np.rot90(upright, 3))
    signal = hdr_signal(to_bt2020(light_of(stored)), HLG)
    luma, *chroma = to_planes(signal, BT2020, 10)
    small = [cv2.resize(plane, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for plane in chroma]
    ticks = [0, 20, 40, 50, 90, 110, 130, 150]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=600, options={"x265-params": "log-level=none:crf=10"})
        stream.width, stream.height, stream.pix_fmt = stored.shape[1], stored.shape[0], "yuv420p10le"
        stream.codec_tag = "hvc1"
        stream.set_display_rotation(90)
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc, context.color_range = 9, 9, HLG, 1
        for tick in ticks:
            frame = av.VideoFrame(stored.shape[1], stored.shape[0], "yuv420p10le")
            frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range = 9, 9, HLG, 1
            frame.pts = tick
            for plane, values in zip(frame.planes, (luma, *small), strict=True):
                padded = np.zeros((values.shape[0], plane.line_size // 2), np.uint16)
                padded[:, : values.shape[1]] = values
                plane.update(padded.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert main(["capture", str(path), "--out", str(tmp_path / "me"), "--capture.crop", "none"]) == 0
    said = capsys.readouterr().err
    assert "HDR video (HLG); its pictures are tone-mapped" in said
    assert "(variable rate); all are kept, each with its own time" in said
    assert "warning" not in said
    capture = read_capture(tmp_path / "me/sequences/IMG_0001/capture")
    assert capture.images.shape == (8, 1, *upright.shape)
    assert capture.valid.all()
    np.testing.assert_allclose(capture.timestamps, np.array(ticks) / 600, atol=1e-4)
    # Highlights are compressed; darker colours are restored.
    ordinary = upright.max(axis=-1) < 200
    assert np.abs(capture.images[4, 0].astype(int) - upright)[ordinary].mean() < 3
