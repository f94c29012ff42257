"""Pictures are written as the ending asks for, with straight alpha, and everything wrong is refused before any work."""

import math
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch

from mien.camera import camera_from_fov
from mien.capture.video import probe_video
from mien.commands.picture import PictureOptions
from mien.commands.stages.pictures import draw
from mien.errors import UserError
from mien.export.output import plan_output
from mien.export.pictures import write_pictures
from mien.export.pixels import to_rgb, to_rgba
from mien.gaussians import Gaussians, sh_from_rgb
from mien.render.camera_paths import read_cameras, sway, write_cameras
from mien.storage import write_json

FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def disc(size: int = 64) -> np.ndarray:
    """Return a reddish disc with a soft edge as straight RGBA."""
    rows, columns = np.mgrid[:size, :size] + 0.5
    distance = np.hypot(rows - size / 2, columns - size / 2)
    alpha = np.clip((size / 3 - distance) / 4 + 0.5, 0, 1).astype(np.float32)
    colors = np.broadcast_to(np.array([0.8, 0.3, 0.2], np.float32), (size, size, 3))
    return to_rgba(colors * alpha[..., None], alpha)


def test_colors_are_straight() -> None:
    picture = disc()
    seen = picture[..., 3] > 8
    assert np.abs(picture[seen][:, :3].astype(int) - [204, 77, 51]).max() <= 1
    assert (seen & (picture[..., 3] < 200)).sum() > 0
    assert (picture[picture[..., 3] == 0] == 0).all()


def test_png_keeps_every_value(tmp_path: Path) -> None:
    write_pictures(plan_output(tmp_path / "a.png", 1, True), [disc()], 25)
    read = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None
    assert np.array_equal(cv2.cvtColor(read, cv2.COLOR_BGRA2RGBA), disc())


def test_webm_keeps_alpha_and_outlines_have_no_fringe(tmp_path: Path) -> None:
    write_pictures(plan_output(tmp_path / "a.webm", 3, True), [disc(65)] * 3, 25)
    decoder, frames = av.CodecContext.create("libvpx-vp9", "r"), []
    assert isinstance(decoder, av.VideoCodecContext)
    with av.open(str(tmp_path / "a.webm")) as container:
        for packet in container.demux(container.streams.video[0]):
            frames += [straight(frame) for frame in decoder.decode(packet if packet.size else None)]
    assert len(frames) == 3
    expected = np.pad(disc(65), ((0, 1), (0, 1), (0, 0)), mode="edge")
    colors, alpha = frames[1]
    assert np.abs(alpha.astype(int) - expected[..., 3]).mean() < 1
    edge = (expected[..., 3] > 40) & (expected[..., 3] < 220)
    assert np.abs(colors[edge].astype(int) - [204, 77, 51]).max() < 25, "black bleeds into the outline"


def straight(frame: av.VideoFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return colours and alpha. Alpha is taken as decoded, since swscale reads beyond the rows of alpha planes."""
    plane = frame.planes[3]
    rows = np.frombuffer(bytes(plane), np.uint8).reshape(plane.height, plane.line_size)
    return frame.to_ndarray(format="rgb24"), rows[:, : plane.width].copy()


def test_films_and_sequences(tmp_path: Path) -> None:
    """Pictures become films or numbered files, depending on the name."""
    pictures = [disc()[..., :3]] * 4
    for name in ("a.mp4", "a.webm"):
        write_pictures(plan_output(tmp_path / name, 4), pictures, 25)
        assert probe_video(tmp_path / name).frames == 4
    write_pictures(plan_output(tmp_path / "frames", 4), pictures, 25)
    write_pictures(plan_output(tmp_path / "f_%03d.png", 4), pictures, 25)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [f"{i:06d}.png" for i in range(4)]
    assert (tmp_path / "f_003.png").is_file()
    with pytest.raises(UserError, match="longer sequence"):
        plan_output(tmp_path / "frames", 2)


@pytest.mark.parametrize(
    ("name", "frames", "transparent", "part"),
    [
        ("a.gif", 1, False, "cannot write .gif"),
        ("a.png", 5, False, "a_%06d.png"),
        ("a.mp4", 5, True, "cannot be transparent"),
        ("file/a.mp4", 5, False, "not a folder|Not a directory"),
        ("file", 5, False, "is a file"),
    ],
)
def test_what_cannot_be_written_is_told_first(
    name: str, frames: int, transparent: bool, part: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=part):
        plan_output(tmp_path / name, frames, transparent)


def test_options_of_pictures(tmp_path: Path) -> None:
    """Impossible sizes and colours of pictures are refused by name."""
    assert PictureOptions(background="#3060a0").color() == (48 / 255, 96 / 255, 160 / 255)
    for options, part in (
        (PictureOptions(size=8193), "--size 8193"),
        (PictureOptions(width=5), "--width 5"),
        (PictureOptions(background="pinkish"), "--background pinkish"),
    ):
        with pytest.raises(UserError, match=part):
            options.plan(tmp_path / "a.png", 1)


def test_one_view_over_every_background() -> None:
    """Straight colours and alpha, put over a colour, give the picture rendered over it."""
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, -0.6]]), quats=torch.tensor([[1.0, 0, 0, 0]]), scales=torch.full((1, 3), 0.04),
        opacities=torch.tensor([0.8]), sh=sh_from_rgb(torch.tensor([[[0.9, 0.4, 0.1]]])),
    )  # fmt: skip
    camera = camera_from_fov(0.6, 48, 48, FACING)
    blue = draw(PictureOptions(background="#0000ff"), gaussians, camera)
    clear = draw(PictureOptions(background="transparent"), gaussians, camera).astype(float)
    alpha = clear[..., 3:] / 255
    assert np.abs(clear[..., :3] * alpha + (1 - alpha) * [0, 0, 255] - blue).max() <= 2
    assert to_rgb(np.full((600, 2, 3), 1.5, np.float32)).min() == 255


def test_other_shapes_keep_the_head_whole() -> None:
    camera = camera_from_fov(0.6, 100, 80, FACING)
    wide = camera.fitted(400, 160)
    corners = torch.tensor([[0.0, 0, -1], [0.1, 0.1, -1]])
    (old, _), (new, _) = camera.project(corners), wide.project(corners)
    torch.testing.assert_close(new - torch.tensor([200.0, 80.0]), 2 * (old - torch.tensor([50.0, 40.0])))
    near = camera.fitted(100, 80, zoom=2.0)
    torch.testing.assert_close(near.project(corners)[0][0], old[0])


def test_sway_loops_around_the_head() -> None:
    camera, center = camera_from_fov(0.5, 64, 64, FACING), torch.tensor([0.0, 0.0, -0.6])
    views = sway(camera, center, 8, math.radians(40), math.radians(20))
    torch.testing.assert_close(views[0].viewmat, camera.viewmat, atol=1e-6, rtol=0)
    for view in views:
        torch.testing.assert_close(view.project(center)[0], torch.tensor([32.0, 32.0]), atol=1e-3, rtol=0)
        assert float((view.position - center).norm()) == pytest.approx(0.6, abs=1e-5)
    right, high = views[2].position - center, views[1].position
    assert float(right[0]) == pytest.approx(0.6 * math.sin(math.radians(20)), abs=1e-5)
    assert float(high[1]) == pytest.approx(0.6 * math.sin(math.radians(10)), abs=1e-5)
    oval = sway(camera, center, 8, math.radians(40), math.radians(20), crossing=False)
    assert float(oval[0].position[1]) == pytest.approx(0.6 * math.sin(math.radians(10)), abs=1e-5)


def test_cameras_from_a_file(tmp_path: Path) -> None:
    """Cameras survive a file, and impossible ones are refused."""
    path, camera = tmp_path / "path.json", camera_from_fov(0.6, 100, 80, FACING)
    write_cameras(path, [camera, camera])
    read = read_cameras(path)
    assert len(read) == 2
    assert torch.equal(read[1].viewmat, camera.viewmat)
    assert torch.equal(read[1].K, camera.K)
    entry = {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist(), "width": 100, "height": 80}
    for wrong, part in (
        ([], "no list"),
        ([{**entry, "K": [[1]]}], "camera 0: K must be 3x3"),
        ([entry, {**entry, "viewmat": (2 * torch.eye(4)).tolist()}], "camera 1: viewmat is not a rotation"),
        ([{**entry, "width": 100000}], "100000x80"),
        ([{**entry, "K": "big"}], "needs K"),
        ([3], "has no K"),
    ):
        write_json(path, "mien.cameras", 1, {"cameras": wrong})
        with pytest.raises(UserError, match=part):
            read_cameras(path)
