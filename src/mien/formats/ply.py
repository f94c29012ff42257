"""The standard .ply format of 3D Gaussians, which viewers, editors and game engines read."""

import math
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from mien.disk.files import write_atomically
from mien.disk.limits import rigid_fault
from mien.disk.reading import open_ordinary
from mien.errors import UserError
from mien.formats.format import Content, Options, pose_words
from mien.gaussians import Gaussians

_MAX_HEADER_BYTES = 65536
_REST_COEFFICIENTS = {0: 1, 9: 4, 24: 9, 45: 16}
"""Number of SH coefficients (1, 4, 9, 16) by the number of f_rest_* properties."""
_MAX_COUNT_DIGITS = 12
MAX_GAUSSIANS = 2_000_000
"""Largest number of Gaussians that is read: a head has tens of thousands, and memory grows with it."""
_MAX_BYTES = 1 << 29
"""Most bytes of vertices that are read: that number of Gaussians, with spherical harmonics of degree 3."""
_TYPES = {
    "char": "<i1", "int8": "<i1", "uchar": "<u1", "uint8": "<u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
"""numpy's type by the name of a type in the header."""
_FIRST_LINE = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")
_READ = re.compile(r"[xyz]|opacity|f_(dc|rest)_[0-9]+|scale_[0-9]+|rot_[0-9]+")
"""Names of the properties that are read, which have one of these types."""
_FLOATS = ("float", "float32", "double", "float64")
BINDING = "binding_0"
"""Property of GaussianAvatars' files: the index of the triangle in whose frame a Gaussian is given."""
_LOCAL_COMMENT = "mien frame: local"
_WORLD_COMMENT = "mien frame: world"


def property_names(sh_coefficients: int) -> list[str]:
    """The file's properties in order, all float32, for k = 1, 4, 9 or 16 SH coefficients per channel."""
    rest = [f"f_rest_{i}" for i in range(3 * (sh_coefficients - 1))]
    dc, scales, quats = ([f"{name}_{i}" for i in range(n)] for name, n in (("f_dc", 3), ("scale", 3), ("rot", 4)))
    return ["x", "y", "z", "nx", "ny", "nz", *dc, *rest, "opacity", *scales, *quats]


def write_ply(path: Path, gaussians: Gaussians, degree: int | None = None) -> None:
    """Write unbatched Gaussians as binary little-endian .ply with raw values, in the layout of the 3DGS training code.

    `opacity` is a logit, `scale_*` are natural logarithms of metres, `rot_*` is wxyz of unit length, and `f_rest_*`
    holds all coefficients of red, then of green, then of blue. Normals are zero. Positions are in the Gaussians' local
    frame if `T_world_local` is set, and in world space otherwise. A comment line keeps that pose for `read_ply`. Other
    programs have no local frame: use `in_world` first if the pose matters to them.

    Args:
        path: The file.
        gaussians: Gaussians.
        degree: Degree of the spherical harmonics in the file, 0 to 3. Coefficients that the Gaussians lack are zero,
            which does not change their colours: some programs read only degree 3. By default, that of the Gaussians.

    Raises:
        UserError: a value is NaN or infinite, or the Gaussians have a higher degree.
    """
    assert not gaussians.batched, "write one timestep: gaussians.timestep(t)"
    if degree is not None:
        gaussians = _padded(path, gaussians, degree)
    rows = _raw_rows(gaussians)
    if not np.isfinite(rows).all():
        bad = int((~np.isfinite(rows)).any(1).sum())
        raise UserError(f"{path}: {bad} of {len(rows)} Gaussians are NaN or infinite; train it again")
    frame = _WORLD_COMMENT
    if gaussians.T_world_local is not None:
        pose = gaussians.T_world_local.detach().cpu().double().flatten().tolist()
        frame = _LOCAL_COMMENT + ", T_world_local row by row: " + " ".join(repr(value) for value in pose)
    properties = "".join(f"property float {name}\n" for name in property_names(gaussians.sh.shape[-2]))
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {frame}\ncomment units: metres\n"
        f"element vertex {len(rows)}\n{properties}end_header\n"
    )

    def write(temporary: Path) -> None:
        temporary.write_bytes(header.encode("ascii") + rows.tobytes())

    write_atomically(path, write)


def _padded(path: Path, gaussians: Gaussians, degree: int) -> Gaussians:
    sh, coefficients = gaussians.sh, (degree + 1) ** 2
    if sh.shape[1] > coefficients:
        own = math.isqrt(sh.shape[1]) - 1
        raise UserError(f"{path}: --sh {degree}: the avatar has degree {own}; give {own} or more, or leave it out")
    return replace(gaussians, sh=torch.cat([sh, sh.new_zeros(len(sh), coefficients - sh.shape[1], 3)], dim=1))


def read_ply(path: Path) -> Gaussians:
    """Read a 3D Gaussian .ply of mien or of another program. Unknown properties are skipped.

    Raises:
        UserError: the file is missing, truncated, not a ply, ASCII or big-endian, or holds NaN or no 3D Gaussians; or
            its Gaussians are given in the frames of triangles (`BINDING`), so that they have no place without a mesh.
    """
    columns, lines = read_columns(path)
    if BINDING in columns:
        raise UserError(
            f"{path}: its Gaussians are in the frames of triangles ({BINDING}), as GaussianAvatars writes them, and "
            "have no place without their mesh; import the folder that also has flame_param.npz: `mien import FOLDER "
            "--out DIR`"
        )
    return _activated(columns, _pose_of(path, lines), path)


def read_columns(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The columns of a 3D Gaussian .ply by name, and the lines of its header.

    Columns have the types of the file.
    """
    try:
        with open_ordinary(path) as file:
            lines = _read_header(path, file)
            count, row = _parse_header(path, lines)
            expected, left = count * row.itemsize, os.fstat(file.fileno()).st_size - file.tell()
            if left < expected:
                raise UserError(
                    f"{path}: is truncated: it has {left} of {expected} bytes of vertices; copy or export it again"
                )
            if count > MAX_GAUSSIANS:
                raise UserError(f"{path}: has {count:,} Gaussians, more than {MAX_GAUSSIANS:,}; remove some of them")
            if expected > _MAX_BYTES:
                raise UserError(
                    f"{path}: has {expected:,} bytes of vertices, more than {_MAX_BYTES:,}; leave columns out"
                )
            body = file.read(expected)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{path}: cannot be read ({reason}); give the path of a 3D Gaussian .ply") from None
    rows = np.frombuffer(body, dtype=row, count=count)
    return {name: rows[name] for name in row.names or ()}, lines


def stacked(columns: dict[str, np.ndarray], names: list[str], path: Path) -> Tensor:
    """Some columns side by side, [n, len(names)] float32."""
    missing = [name for name in names if name not in columns]
    if missing:
        raise UserError(f"{path}: lacks {missing[0]}; give a .ply with 3D Gaussians")
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, which callers refuse
        return torch.from_numpy(np.stack([columns[name] for name in names], axis=1).astype(np.float32, copy=False))


def stacked_sh(columns: dict[str, np.ndarray], path: Path) -> Tensor:
    """The spherical harmonics, [n, k, 3]."""
    rest = sum(name.startswith("f_rest_") for name in columns)
    if rest not in _REST_COEFFICIENTS:
        raise UserError(
            f"{path}: has {rest} f_rest_* properties, not 0, 9, 24 or 45 (SH degree 0 to 3); give another .ply"
        )
    coefficients = _REST_COEFFICIENTS[rest]
    dc = stacked(columns, [f"f_dc_{i}" for i in range(3)], path)[:, None]
    higher = dc.new_zeros(len(dc), 0, 3)
    if rest:
        channels = stacked(columns, [f"f_rest_{i}" for i in range(rest)], path).reshape(-1, 3, coefficients - 1)
        higher = channels.transpose(1, 2)
    return torch.cat([dc, higher], dim=1).contiguous()


def _read_header(path: Path, file: IO[bytes]) -> list[str]:
    """The lines before the vertices; the file is left at the first vertex."""
    content = file.read(_MAX_HEADER_BYTES)
    # Vertices may begin with any byte, so the first line decides how lines end.
    first = _FIRST_LINE.match(content)
    last = None if first is None else re.compile(rb"end_header[ \t]*" + first[1]).search(content)
    if last is None:
        raise UserError(f"{path}: is not a .ply file; give one with 3D Gaussians, as `mien export` writes")
    file.seek(last.end())
    lines = content[: last.start()].decode("ascii", errors="replace").splitlines()
    return [" ".join(line.split()) for line in lines]


def _raw_rows(gaussians: Gaussians) -> Float32[np.ndarray, "n p"]:
    """One row of float32 per Gaussian, in the order of `property_names`."""
    # Logits of exactly 0 and 1 are infinite. Logits of +-16.6 give 6e-8 and the float32 next to 1.
    opacities = gaussians.opacities.detach().double().clamp(6e-8, 1 - 6e-8)
    columns = (
        gaussians.means.detach(),
        torch.zeros_like(gaussians.means),
        gaussians.sh[:, 0].detach(),
        gaussians.sh[:, 1:].detach().transpose(1, 2).flatten(1),
        torch.logit(opacities)[:, None],
        gaussians.scales.detach().double().log(),
        torch.nn.functional.normalize(gaussians.quats.detach(), dim=-1),
    )
    return torch.cat([column.cpu().float() for column in columns], dim=1).numpy().astype("<f4", order="C", copy=False)


def _parse_header(path: Path, lines: list[str]) -> tuple[int, np.dtype]:
    """The number of vertices and the layout of one. Those of `_READ` must be floats, others any number."""
    if "format binary_little_endian 1.0" not in lines:
        found = next((line for line in lines if line.startswith("format")), "no format line")
        raise UserError(f"{path}: {found!r} is not supported; save it as binary_little_endian 1.0")
    elements = [line.split() for line in lines if line.startswith("element")]
    if any("packed_position" in line for line in lines):
        raise UserError(f"{path}: is a compressed .ply, as PlayCanvas' tools write; save it uncompressed, or as .sog")
    if not elements or elements[0][1:2] != ["vertex"] or len(elements[0]) != 3 or not elements[0][2].isdigit():
        raise UserError(f"{path}: its first element is not `vertex` and a number; give a .ply with 3D Gaussians")
    start = next(i for i, line in enumerate(lines) if line.startswith("element")) + 1
    properties: list[list[str]] = []
    for line in lines[start:]:
        if line.startswith("element"):
            break
        if line.startswith("property"):
            properties.append(line.split())
    others = [" ".join(entry) for entry in properties if not _is_known_type(entry)]
    names = [entry[-1] for entry in properties]
    missing = [name for name in ("x", "f_dc_0", "opacity", "scale_0", "rot_0") if name not in names]
    if missing or others:
        reason = f"lacks {', '.join(missing)}" if missing else f"has {others[0]!r}, not float"
        raise UserError(f"{path}: {reason}; give a .ply with 3D Gaussians in full precision")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{path}: has the property {twice!r:.60} twice; give a .ply with 3D Gaussians")
    if len(elements[0][2]) > _MAX_COUNT_DIGITS:
        raise UserError(f"{path}: has too many vertices ({elements[0][2][:_MAX_COUNT_DIGITS]}...); export it again")
    return int(elements[0][2]), np.dtype([(entry[2], _TYPES[entry[1]]) for entry in properties])


def _is_known_type(entry: list[str]) -> bool:
    """Whether a property line, split into words, is of a type that its name may have."""
    if len(entry) != 3:
        return False
    return entry[1] in (_FLOATS if _READ.fullmatch(entry[2]) else _TYPES)


def _pose_of(path: Path, lines: list[str]) -> Tensor | None:
    """T_world_local from the comment line, or None for a file in world space or of another program."""
    marked = [line for line in lines if line.startswith(f"comment {_LOCAL_COMMENT}")]
    if not marked:
        return None
    try:
        pose = torch.tensor([float(value) for value in marked[0].split(":")[-1].split()]).reshape(4, 4)
        if rigid_fault(pose.numpy()) is not None:
            raise ValueError
        return pose
    except (ValueError, RuntimeError):
        raise UserError(f"{path}: has a damaged frame comment, {marked[0]!r}; export it again") from None


def _activated(columns: dict[str, np.ndarray], pose: Tensor | None, path: Path) -> Gaussians:
    """Gaussians from raw columns by name."""
    gaussians = Gaussians(
        means=stacked(columns, ["x", "y", "z"], path),
        quats=stacked(columns, [f"rot_{i}" for i in range(4)], path),
        scales=stacked(columns, [f"scale_{i}" for i in range(3)], path).exp(),
        opacities=torch.sigmoid(stacked(columns, ["opacity"], path)[:, 0]),
        sh=stacked_sh(columns, path),
        T_world_local=pose,
    )
    columns_read = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh.flatten(1))
    bad = [not tensor.isfinite().all() for tensor in columns_read]
    if any(bad):
        name = ("position", "rotation", "scale", "opacity", "color")[bad.index(True)]
        raise UserError(f"{path}: the {name} of some Gaussians is NaN or infinite; export it again, or clean it up")
    return gaussians


def write(path: Path, content: Content, options: Options) -> str:
    """Write the file, and return what is told of it."""
    write_ply(path, content.pose(), options.sh)
    return pose_words(path, content)
