""".ply files have the bytes of a layout built by hand, keep frames, and are refused if damaged or foreign."""

import struct
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mien.camera import camera_from_fov
from mien.cli import main
from mien.errors import UserError
from mien.export import in_world, read_ply, write_ply
from mien.export.ply import property_names
from mien.render import rasterize
from mien.rotation import matrix_from_axis_angle, rigid_transform
from shared_things import MadeOnce, toy_workspace
from test_splat_files import some


def test_layout_is_the_one_other_programs_write(tmp_path: Path) -> None:
    """The layout is that of other programs, with the bytes of one Gaussian built from the format's description."""
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


def test_local_frame_is_kept(tmp_path: Path) -> None:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 1 / 3])
    local = some(5, 1)
    write_ply(tmp_path / "a.ply", replace(local, T_world_local=pose))
    read = read_ply(tmp_path / "a.ply")
    assert read.T_world_local is not None
    assert torch.equal(read.T_world_local, pose)
    assert torch.equal(read.means, local.means)


@pytest.mark.parametrize("coefficients", [1, 16])
def test_in_world_looks_the_same(coefficients: int) -> None:
    """Gaussians moved into the world look the same: positions, rotations and colours that depend on the view."""
    pose = rigid_transform(matrix_from_axis_angle(torch.tensor([0.4, -0.9, 0.2])), torch.tensor([0.05, 0.02, -0.5]))
    local = some(80, coefficients)
    local = replace(local, T_world_local=pose)
    camera = camera_from_fov(0.6, 48, 40, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))
    moved = in_world(local)
    assert moved.T_world_local is None
    with torch.no_grad():
        pictures = [rasterize(one, camera, torch.ones(3), backend="reference").image for one in (local, moved)]
    assert float(pictures[0].std()) > 0.05
    torch.testing.assert_close(*pictures, atol=1e-4, rtol=0)


def test_damaged_and_foreign_files(tmp_path: Path) -> None:
    good = tmp_path / "good.ply"
    write_ply(good, some(5, 1))
    content = good.read_bytes()
    cases = {
        "truncated": content[:-7],
        "is not a .ply": b"GIF89a" + content,
        "not supported": content.replace(b"binary_little_endian", b"ascii", 1),
        "lacks f_dc_0": content.replace(b"f_dc_0", b"red_is"),
        "lacks y": content.replace(b"float y", b"float w"),
        "not float": content.replace(b"property float x", b"property double x"),
        "first element": content.replace(b"element vertex", b"element corner"),
    }
    for message, damaged in cases.items():
        path = tmp_path / "damaged.ply"
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=message):
            read_ply(path)
    with pytest.raises(UserError, match="cannot be read"):
        read_ply(tmp_path / "missing.ply")


def test_nan_is_not_written(tmp_path: Path) -> None:
    gaussians = some(3, 1)
    gaussians.means[1, 0] = torch.nan
    with pytest.raises(UserError, match="1 of 3 Gaussians"):
        write_ply(tmp_path / "a.ply", gaussians)
    assert not list(tmp_path.iterdir())


def test_a_ply_can_have_coefficients_of_degree_3(
    tmp_path: Path, made_once: MadeOnce, capsys: pytest.CaptureFixture[str]
) -> None:
    """Some programs expect 248 bytes for each Gaussian. The colours stay the same."""
    line = ["export", str(toy_workspace(made_once)), "--out"]
    assert main([*line, str(tmp_path / "own.ply")]) == 0
    assert main([*line, str(tmp_path / "me.mien")]) == 0
    assert main([*line, str(tmp_path / "padded.ply"), "--sh", "3"]) == 0
    assert main([*line, str(tmp_path / "s.ply"), "--series", "clip", "--sh", "3"]) == 0
    assert main(["export", str(tmp_path / "me.mien"), "--out", str(tmp_path / "file.ply"), "--sh", "3"]) == 0
    own = read_ply(tmp_path / "own.ply")
    for path in (tmp_path / "padded.ply", tmp_path / "s_000000.ply", tmp_path / "file.ply"):
        data = path.read_bytes()
        assert len(data) - data.index(b"end_header\n") - len(b"end_header\n") == 248 * len(own)
        assert read_ply(path).sh.shape == (len(own), 16, 3)
    padded = read_ply(tmp_path / "padded.ply")
    assert torch.equal(padded.sh[:, : own.sh.shape[1]], own.sh)
    assert not padded.sh[:, own.sh.shape[1] :].any()
    assert torch.equal(padded.means, own.means)
    capsys.readouterr()
    assert main([*line, str(tmp_path / "a.spz"), "--sh", "3"]) == 2
    assert "only a .ply has a degree to choose; leave --sh out" in capsys.readouterr().err
    with pytest.raises(UserError, match="--sh 1: the avatar has degree 3; give 3 or more, or leave it out"):
        write_ply(tmp_path / "b.ply", padded, 1)
