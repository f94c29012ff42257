""".ply files, options of `mien export`, pictures and films: what is wrong is refused before any work."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch

from known import known
from mien import runtime
from mien.camera import camera_from_fov
from mien.cli import main
from mien.disk.files import write_json
from mien.formats import in_world, read_ply, write_ply
from mien.formats.ply import property_names
from mien.gaussians import Gaussians, sh_from_rgb
from mien.media.output import plan_output
from mien.media.pixels import to_rgb, to_rgba
from mien.media.video import probe_video
from mien.media.writing import write_pictures
from mien.pipeline.draw import draw
from mien.pipeline.picture_options import PictureOptions
from mien.render import rasterize
from mien.render.camera_paths import read_cameras, turned_camera
from mien.rotation import matrix_from_axis_angle, rigid_transform
from mien.runtime.camera_paths import sway
from refusals import complaint, refuses
from shared_things import MadeOnce, toy_workspace
from test_splat_files import some
from web_case import drawn_head


def test_layout_is_the_one_other_programs_write(tmp_path: Path) -> None:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    red, green, blue = (11.0, 12.0, 13.0), (21.0, 22.0, 23.0), (31.0, 32.0, 33.0)
    row = (1, 2, 3, 0, 0, 0, 10, 20, 30, *red, *green, *blue, 0, -1, -2, -3, 0, 0.6, 0, 0.8)
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    path = tmp_path / "other.ply"
    path.write_bytes(header.encode() + struct.pack(f"<{len(row)}f", *row))
    read = read_ply(path)
    assert read.means.tolist() == [[1, 2, 3]]
    assert read.sh[0].tolist() == [[10, 20, 30], [11, 21, 31], [12, 22, 32], [13, 23, 33]]
    assert float(read.opacities[0]) == 0.5
    torch.testing.assert_close(read.scales[0], torch.tensor([-1.0, -2.0, -3.0]).exp())
    torch.testing.assert_close(read.quats[0], torch.tensor([0, 0.6, 0, 0.8]))
    assert read.T_world_local is None
    ours = tmp_path / "ours.ply"
    write_ply(ours, read)
    content = ours.read_bytes()
    assert content[-len(row) * 4 :] == struct.pack(f"<{len(row)}f", *row)
    lines = content[: content.index(b"end_header\n")].decode().splitlines()
    assert [line.split()[-1] for line in lines if line.startswith("property float")] == names == property_names(4)
    assert "comment mien frame: world" in lines


def test_a_local_frame_is_kept_and_gaussians_in_world_look_the_same(tmp_path: Path) -> None:
    pose = rigid_transform(matrix_from_axis_angle(torch.tensor([0.4, -0.9, 0.2])), torch.tensor([0.05, 0.02, -1 / 3]))
    local = replace(some(80, 16), T_world_local=pose)
    write_ply(tmp_path / "a.ply", local)
    read = read_ply(tmp_path / "a.ply")
    assert torch.equal(known(read.T_world_local), pose)
    assert torch.equal(read.means, local.means)
    camera = camera_from_fov(0.6, 48, 40, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    moved = in_world(local)
    assert moved.T_world_local is None
    with torch.no_grad():
        pictures = [rasterize(one, camera, torch.ones(3), backend="reference").image for one in (local, moved)]
    assert float(pictures[0].std()) > 0.05
    torch.testing.assert_close(*pictures, atol=1e-4, rtol=0)


def test_damaged_and_foreign_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    refuses("cannot be read", read_ply, path)
    write_ply(path, some(5, 1))
    content = path.read_bytes()
    for message, damaged in {
        "truncated": content[:-7],
        "is not a .ply": b"GIF89a" + content,
        "not supported": content.replace(b"binary_little_endian", b"ascii", 1),
        "lacks f_dc_0": content.replace(b"f_dc_0", b"red_is"),
        "first element": content.replace(b"element vertex", b"element corner"),
    }.items():
        path.write_bytes(damaged)
        refuses(message, read_ply, path)


def test_a_ply_can_have_coefficients_of_degree_3(tmp_path: Path, made_once: MadeOnce) -> None:
    """Some programs expect 248 bytes for each Gaussian. The colours stay the same."""
    workspace, file = toy_workspace(made_once), tmp_path / "me.mien"
    padded, series, by_file = (tmp_path / name for name in ("padded.ply", "s.ply", "file.ply"))
    for source, out, *options in (
        (workspace, tmp_path / "own.ply"), (workspace, file), (workspace, padded, "--sh", "3"),
        (workspace, series, "--series", "clip", "--sh", "3"), (file, by_file, "--sh", "3"),
    ):  # fmt: skip
        assert main(["export", str(source), "--out", str(out), *options]) == 0
    own = read_ply(tmp_path / "own.ply")
    for path in (padded, tmp_path / "s_000000.ply", by_file):
        assert len(path.read_bytes().partition(b"end_header\n")[2]) == 248 * len(own)
        assert read_ply(path).sh.shape == (len(own), 16, 3)
    found = read_ply(padded)
    assert torch.equal(found.sh[:, : own.sh.shape[1]], own.sh)
    assert not found.sh[:, own.sh.shape[1] :].any()
    assert torch.equal(found.means, own.means)
    refuses("--sh 1: the avatar has degree 3; give 3 or more, or leave it out", write_ply, tmp_path / "b.ply", found, 1)


def test_options_that_do_not_fit_the_output_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runtime.write_portable(tmp_path / "me.mien", drawn_head(10))
    for name, told, *options in (
        ("a.spz", "a.spz: --sh is an option of ply, not of spz; leave it out", "--sh", "3"),
        ("a.spz", "--y-down is an option of ply or sog, not of spz", "--y-down"),
        ("a.ply", "--largest is an option of html or packed, not of ply", "--largest", "1"),
        ("a.html", "--largest 0: give a number of MB above 0", "--largest", "0"),
        ("a.html", "--largest nan: give a number of MB above 0", "--largest", "nan"),
        ("a.ply", "--sharp-cut is an option of mien, html or packed", "--sharp-cut"),
        ("a.glb", "a file does not have all that this format needs; export its workspace"),
        ("me.mien", "is the file that is read"),
        ("c.mien", "--set is an option of ply, spz, sog or usd, not of mien", "--set", "drop=1"),
        ("c.ply", "leave --run, --set and --series out", "--set", "drop=1"),
        ("c.ply", "--every and --neutral are for a motion", "--every", "2"),
    ):
        assert told in complaint(capsys, "export", tmp_path / "me.mien", "--out", tmp_path / name, *options)
    assert [path.name for path in tmp_path.iterdir()] == ["me.mien"]


FACING = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def disc(size: int = 64) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    distance = np.hypot(rows - size / 2, columns - size / 2)
    alpha = np.clip((size / 3 - distance) / 4 + 0.5, 0, 1).astype(np.float32)
    colors = np.broadcast_to(np.array([0.8, 0.3, 0.2], np.float32), (size, size, 3))
    return to_rgba(colors * alpha[..., None], alpha)


def test_colors_are_straight_a_png_keeps_every_value_and_outlines_have_no_fringe(tmp_path: Path) -> None:
    picture = disc()
    seen = picture[..., 3] > 8
    assert np.abs(picture[seen][:, :3].astype(int) - [204, 77, 51]).max() <= 1
    assert (seen & (picture[..., 3] < 200)).any()
    assert not picture[picture[..., 3] == 0].any()
    write_pictures(plan_output(tmp_path / "a.png", 1, True), [picture], 25)
    read = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None
    assert np.array_equal(cv2.cvtColor(read, cv2.COLOR_BGRA2RGBA), picture)
    write_pictures(plan_output(tmp_path / "a.webm", 3, True), [disc(65)] * 3, 25)
    decoder, frames = av.CodecContext.create("libvpx-vp9", "r"), []
    assert isinstance(decoder, av.VideoCodecContext)
    with av.open(str(tmp_path / "a.webm")) as container:
        for packet in container.demux(container.streams.video[0]):
            frames += decoder.decode(packet if packet.size else None)
    assert len(frames) == 3
    expected = np.pad(disc(65), ((0, 1), (0, 1), (0, 0)), mode="edge")
    colors, plane = frames[1].to_ndarray(format="rgb24"), frames[1].planes[3]
    # Alpha is taken as decoded, since swscale reads beyond the rows of alpha planes.
    alpha = np.frombuffer(bytes(plane), np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
    assert np.abs(alpha.astype(int) - expected[..., 3]).mean() < 1
    edge = (expected[..., 3] > 40) & (expected[..., 3] < 220)
    assert np.abs(colors[edge].astype(int) - [204, 77, 51]).max() < 25, "black bleeds into the outline"


def test_films_and_sequences(tmp_path: Path) -> None:
    """Pictures become films or numbered files, depending on the name. What cannot be written is told first."""
    for name in ("a.mp4", "a.webm", "frames", "f_%03d.png"):
        write_pictures(plan_output(tmp_path / name, 4), [disc()[..., :3]] * 4, 25)
    assert [probe_video(tmp_path / name).frames for name in ("a.mp4", "a.webm")] == [4, 4]
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [f"{i:06d}.png" for i in range(4)]
    assert (tmp_path / "f_003.png").is_file()
    (tmp_path / "file").write_text("")
    for name, frames, transparent, part in (
        ("a.gif", 1, False, "cannot write .gif"), ("a.png", 5, False, "a_%06d.png"),
        ("a.mp4", 5, True, "cannot be transparent"), ("file/a.mp4", 5, False, "not a folder|Not a directory"),
        ("file", 5, False, "is a file"), ("frames", 2, False, "longer sequence"),
    ):  # fmt: skip
        refuses(part, plan_output, tmp_path / name, frames, transparent)
    assert PictureOptions(background="#3060a0").color() == (48 / 255, 96 / 255, 160 / 255)
    wrong = (PictureOptions(size=8193), PictureOptions(width=5), PictureOptions(background="pinkish"))
    for options, part in zip(wrong, ("--size 8193", "--width 5", "--background pinkish"), strict=True):
        refuses(part, options.plan, tmp_path / "a.png", 1)


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


def test_cameras_sway_around_the_head_and_come_from_a_file(tmp_path: Path) -> None:
    camera, center = camera_from_fov(0.5, 64, 64, FACING), torch.tensor([0.0, 0.0, -0.6])
    angles = sway(8, math.radians(40), math.radians(20))
    views = [turned_camera(camera, center, *each) for each in angles]
    torch.testing.assert_close(views[0].viewmat, camera.viewmat, atol=1e-6, rtol=0)
    for view in views:
        torch.testing.assert_close(view.project(center)[0], torch.tensor([32.0, 32.0]), atol=1e-3, rtol=0)
        assert float((view.position - center).norm()) == pytest.approx(0.6, abs=1e-5)
    assert float((views[2].position - center)[0]) == pytest.approx(0.6 * math.sin(math.radians(20)), abs=1e-5)
    path, camera = tmp_path / "path.json", camera_from_fov(0.6, 100, 80, FACING)
    entry = {"K": camera.K.tolist(), "viewmat": camera.viewmat.tolist(), "width": 100, "height": 80}
    write_json(path, "mien.cameras", 1, {"cameras": [entry, entry]})
    _, read = read_cameras(path)
    assert torch.equal(read.viewmat, camera.viewmat)
    assert torch.equal(read.K, camera.K)
    turned = entry | {"viewmat": (2 * torch.eye(4)).tolist()}
    for wrong, part in (
        ([], "no list"), ([entry | {"K": [[1]]}], "camera 0: K must be 3x3"), ([3], "has no K"),
        ([entry, turned], "camera 1: viewmat is not a rotation"), ([entry | {"width": 100000}], "100000x80"),
        ([entry | {"K": "big"}], "needs K"),
    ):  # fmt: skip
        write_json(path, "mien.cameras", 1, {"cameras": wrong})
        refuses(part, read_cameras, path)


def written(path: Path, types: dict[str, str], newline: str, coefficients: int = 4) -> dict[str, np.ndarray]:
    """Write a .ply of 5 Gaussians with these columns, or others, of these numpy types, and return the columns."""
    names = {"float32": "float", "float64": "double", "uint8": "uchar", "int16": "short", "uint32": "uint"}
    columns = [*property_names(coefficients), *(name for name in types if name not in property_names(coefficients))]
    layout = np.dtype([(name, types.get(name, types.get("*", "float32"))) for name in columns])
    rows = np.zeros(5, layout)
    for index, name in enumerate(columns):
        rows[name] = 1 + index % 7 + np.arange(5)
    # The first byte of the vertices is that of a line end, which is no part of the header.
    rows.view(np.uint8)[0] = 10
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    lines += [f"property {names[layout[name].name]} {name}" for name in columns]
    path.write_bytes(newline.join([*lines, "end_header", ""]).encode() + rows.tobytes())
    return {name: rows[name].astype(np.float32) for name in columns}


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("types", [
    {}, {"red": "uint8", "green": "uint8", "blue": "uint8"}, {"nx": "int16", "label": "uint32", "time": "float64"},
    {"*": "float64"},
])  # fmt: skip
def test_every_ply_of_floats_is_read(tmp_path: Path, newline: str, types: dict[str, str]) -> None:
    path = tmp_path / "a.ply"
    columns = written(path, types, newline)
    read = read_ply(path)
    for index, name in enumerate("xyz"):
        np.testing.assert_array_equal(read.means[:, index].numpy(), columns[name])
    np.testing.assert_allclose(read.scales[:, 2].numpy(), np.exp(columns["scale_2"]), rtol=1e-6)
    np.testing.assert_array_equal(read.quats[:, 3].numpy(), columns["rot_3"])
    np.testing.assert_array_equal(read.sh[:, 1, 2].numpy(), columns["f_rest_6"])


@pytest.mark.parametrize(("types", "extra", "words"), [
    ({"x": "uint8"}, "", "has 'property uchar x', not float"),
    ({}, "property list uchar int vertex_indices\n", "has 'property list uchar int vertex_indices', not float"),
    ({}, "property uint packed_position\n", "is a compressed .ply, .* save it uncompressed, or as .sog"),
])  # fmt: skip
def test_other_plys_are_named(tmp_path: Path, types: dict[str, str], extra: str, words: str) -> None:
    path = tmp_path / "a.ply"
    written(path, types, "\n")
    path.write_bytes(path.read_bytes().replace(b"end_header", extra.encode() + b"end_header", 1))
    refuses(words, read_ply, path)
