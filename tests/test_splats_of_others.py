"""Files of Gaussians as other programs write them: line ends, types of columns, compressed ones, older versions."""

import gzip
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from mien.errors import UserError
from mien.export import read_ply, read_spz
from mien.export.ply import property_names


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
    {},
    {"red": "uint8", "green": "uint8", "blue": "uint8"},
    {"nx": "int16", "label": "uint32", "time": "float64"},
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
    ({"f_rest_3": "int16"}, "", "has 'property short f_rest_3', not float"),
    ({}, "property list uchar int vertex_indices\n", "has 'property list uchar int vertex_indices', not float"),
    ({}, "property uint packed_position\n", "is a compressed .ply, .* save it uncompressed, or as .sog"),
])  # fmt: skip
def test_other_plys_are_named(tmp_path: Path, types: dict[str, str], extra: str, words: str) -> None:
    path = tmp_path / "a.ply"
    written(path, types, "\n")
    path.write_bytes(path.read_bytes().replace(b"end_header", extra.encode() + b"end_header", 1))
    with pytest.raises(UserError, match=words):
        read_ply(path)


def spz(path: Path, version: int, quats: list[tuple[int, int, int]], degree: int = 0) -> Path:
    """Write a .spz whose quaternions have three bytes, with one Gaussian for each, 1/4096 m apart along x."""
    count = len(quats)
    header = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0)
    places = b"".join(struct.pack("<i", at)[:3] + bytes(6) for at in range(count))
    rest = bytes([255]) * count + bytes([128, 0, 255]) * count + bytes([160]) * 3 * count
    higher = bytes([192]) * count * ((degree + 1) ** 2 - 1) * 3
    path.write_bytes(gzip.compress(header + places + rest + b"".join(map(bytes, quats)) + higher))
    return path


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_of_version_2_is_read(tmp_path: Path, degree: int) -> None:
    """Quaternions have x, y and z in steps of 1/127.5, and w is what is left."""
    read = read_spz(
        spz(tmp_path / "a.spz", 2, [(128, 127, 128), (255, 128, 127), (0, 127, 128), (204, 128, 51)], degree)
    )
    torch.testing.assert_close(read.means[:, 0], torch.arange(4) / 4096, atol=1e-7, rtol=0)
    expected = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0.529, 0.6, 0, -0.6]])
    torch.testing.assert_close(read.quats, expected, atol=0.005, rtol=0)
    torch.testing.assert_close(read.scales, torch.ones(4, 3))
    assert read.opacities.tolist() == [1] * 4
    assert read.sh.shape == (4, (degree + 1) ** 2, 3)
    assert (read.sh[:, 1:] == 0.5).all()


def test_other_versions_of_spz_are_named(tmp_path: Path) -> None:
    for version in (1, 7):
        with pytest.raises(UserError, match=rf"\(it is of version {version}\); give a .spz of version 2, 3 or 4"):
            read_spz(spz(tmp_path / "a.spz", version, [(128, 128, 128)]))


def test_random_damage_is_told_in_one_line(tmp_path: Path) -> None:
    """Mutations of each new reader's input give Gaussians that are finite, or a UserError."""
    random = np.random.default_rng(0)
    ply, old = tmp_path / "a.ply", spz(tmp_path / "a.spz", 2, [(1, 2, 3)] * 9)
    written(ply, {"red": "uint8", "*": "float64"}, "\r\n", 1)
    for path, read, content in (
        (ply, read_ply, ply.read_bytes()),
        (old, read_spz, gzip.decompress(old.read_bytes())),
    ):
        for _ in range(40):
            damaged = bytearray(content)
            for at in random.integers(0, min(len(damaged), 700), 2):
                damaged[at] = random.integers(256)
            damaged = damaged[: random.integers(1, len(damaged) + 1)] if random.random() < 0.3 else damaged
            path.write_bytes(gzip.compress(bytes(damaged), 1) if path == old else bytes(damaged))
            with suppress(UserError):
                assert all(part.isfinite().all() for part in vars(read(path)).values() if part is not None)
