"""The standard .ply format of 3D Gaussians, which viewers, editors and game engines read."""

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float32

from mien.disk.files import write_atomically
from mien.disk.limits import rigid_fault
from mien.disk.reading import open_ordinary
from mien.errors import UserError
from mien.formats.format import Content, SplatOptions, pose_words
from mien.formats.shared.splats import MAX_GAUSSIANS

if TYPE_CHECKING:
    import mien.gaussians

_MAX_HEADER_BYTES = 65536
_REST_COEFFICIENTS = (0, 9, 24, 45)
"""Numbers of f_rest_* properties of degrees 0 to 3."""
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
_WORDS = {"position": "means", "rotation": "quats", "scale": "scales", "opacity": "opacities", "color": "sh"}
BINDING = "binding_0"
"""Property of GaussianAvatars' files: the index of the triangle in whose frame a Gaussian is given."""
_LOCAL_COMMENT = "mien frame: local"


@dataclass(frozen=True)
class PlyOptions(SplatOptions):
    """Options of .ply files."""

    sh: Literal[0, 1, 2, 3] | None = None
    """Degree of the spherical harmonics in the file. Coefficients that the avatar lacks are zeros, for programs that
    expect those of degree 3: 248 bytes for each Gaussian (default: the avatar's own degree)."""


def property_names(sh_coefficients: int) -> list[str]:
    """The file's properties in order, all float32, for k = 1, 4, 9 or 16 SH coefficients per channel."""
    rest = [f"f_rest_{i}" for i in range(3 * (sh_coefficients - 1))]
    dc, scales, quats = ([f"{name}_{i}" for i in range(n)] for name, n in (("f_dc", 3), ("scale", 3), ("rot", 4)))
    return ["x", "y", "z", "nx", "ny", "nz", *dc, *rest, "opacity", *scales, *quats]


def write_ply(path: Path, gaussians: "mien.gaussians.Gaussians", degree: int | None = None) -> None:
    """Write unbatched Gaussians as binary little-endian .ply with raw values, in the layout of the 3DGS training code.

    `opacity` is a logit, `scale_*` are natural logarithms of metres, `rot_*` is wxyz of unit length, and `f_rest_*`
    holds all coefficients of red, then of green, then of blue. Normals are zero. Positions are in the Gaussians' local
    frame if `T_world_local` is set, and in world space otherwise. A comment line keeps that pose for `read_ply`. Other
    programs have no local frame: use `in_world` first if the pose matters to them.

    `degree` is that of the spherical harmonics in the file, 0 to 3, by default that of the Gaussians. Coefficients that
    the Gaussians lack are zero, which does not change their colours: some programs read only degree 3.
    """
    assert not gaussians.batched, "write one timestep: gaussians.timestep(t)"
    sh, coefficients = gaussians.sh, gaussians.sh.shape[1] if degree is None else (degree + 1) ** 2
    if sh.shape[1] > coefficients:
        own = math.isqrt(sh.shape[1]) - 1
        raise UserError(f"{path}: --sh {degree}: the avatar has degree {own}; give {own} or more, or leave it out")
    columns = _raw_columns(gaussians, coefficients)
    rows = columns.view([(name, "<f4") for name in property_names(coefficients)])[:, 0]
    frame = "mien frame: world"
    if gaussians.T_world_local is not None:
        pose = gaussians.T_world_local.detach().cpu().double().flatten().tolist()
        frame = _LOCAL_COMMENT + ", T_world_local row by row: " + " ".join(repr(value) for value in pose)
    write_rows(path, rows, frame, "units: metres")


def write_rows(path: Path, rows: np.ndarray, *comments: str) -> None:
    """Write records of float32 and int32 as a .ply."""
    bad = sum(~np.isfinite(rows[name]) for name in rows.dtype.names or ()) > 0
    if np.any(bad):
        raise UserError(f"{path}: {np.sum(bad)} of {len(rows)} Gaussians are NaN or infinite; train it again")
    kinds = {np.dtype("<f4"): "float", np.dtype("<i4"): "int"}
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {words}" for words in comments)]
    lines += [f"element vertex {len(rows)}"]
    lines += [f"property {kinds[rows.dtype[name]]} {name}" for name in rows.dtype.names or ()]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    write_atomically(path, lambda temporary: temporary.write_bytes(header + rows.tobytes()))


def read_ply(path: Path) -> "mien.gaussians.Gaussians":
    """Read a 3D Gaussian .ply of mien or of another program. Unknown properties are skipped."""
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


def stacked(columns: dict[str, np.ndarray], names: list[str], path: Path) -> Float32[np.ndarray, "n c"]:
    """Some columns side by side."""
    missing = [name for name in names if name not in columns]
    if missing:
        raise UserError(f"{path}: lacks {missing[0]}; give a .ply with 3D Gaussians")
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, which callers refuse
        return np.stack([columns[name] for name in names], axis=1).astype(np.float32, copy=False)


def stacked_sh(columns: dict[str, np.ndarray], path: Path) -> Float32[np.ndarray, "n k 3"]:
    """The spherical harmonics."""
    rest = sum(name.startswith("f_rest_") for name in columns)
    if rest not in _REST_COEFFICIENTS:
        raise UserError(
            f"{path}: has {rest} f_rest_* properties, not 0, 9, 24 or 45 (SH degree 0 to 3); give another .ply"
        )
    first = stacked(columns, [f"f_dc_{i}" for i in range(3)], path)[:, None]
    if not rest:
        return first
    channels = stacked(columns, [f"f_rest_{i}" for i in range(rest)], path).reshape(len(first), 3, rest // 3)
    return np.concatenate([first, channels.transpose(0, 2, 1)], axis=1)


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


def _raw_columns(gaussians: "mien.gaussians.Gaussians", coefficients: int) -> Float32[np.ndarray, "n p"]:
    """One row of float32 per Gaussian, in the order of `property_names`."""
    import torch

    sh = gaussians.sh.detach()
    sh = torch.cat([sh, sh.new_zeros(len(sh), coefficients - sh.shape[1], 3)], dim=1)
    # Logits of exactly 0 and 1 are infinite. Logits of +-16.6 give 6e-8 and the float32 next to 1.
    opacities = gaussians.opacities.detach().double().clamp(6e-8, 1 - 6e-8)
    columns = (
        gaussians.means.detach(), torch.zeros_like(gaussians.means), sh[:, 0], sh[:, 1:].transpose(1, 2).flatten(1),
        torch.logit(opacities)[:, None], gaussians.scales.detach().double().log(),
        torch.nn.functional.normalize(gaussians.quats.detach(), dim=-1),
    )  # fmt: skip
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
    known = [len(entry) == 3 and entry[1] in (_FLOATS if _READ.fullmatch(entry[2]) else _TYPES) for entry in properties]
    others = [" ".join(entry) for entry, is_known in zip(properties, known, strict=True) if not is_known]
    names = [entry[-1] for entry in properties]
    missing = [name for name in ("x", "f_dc_0", "opacity", "scale_0", "rot_0") if name not in names]
    if missing or others:
        reason = f"lacks {', '.join(missing)}" if missing else f"has {others[0]!r}, not float"
        raise UserError(f"{path}: {reason}; give a .ply with 3D Gaussians in full precision")
    return int(elements[0][2]), np.dtype([(entry[2], _TYPES[entry[1]]) for entry in properties])


def _pose_of(path: Path, lines: list[str]) -> Float32[np.ndarray, "4 4"] | None:
    """T_world_local from the comment line, or None for a file in world space or of another program."""
    marked = [line for line in lines if line.startswith(f"comment {_LOCAL_COMMENT}")]
    if not marked:
        return None
    try:
        with np.errstate(over="ignore"):
            pose = np.array([float(value) for value in marked[0].split(":")[-1].split()], np.float32).reshape(4, 4)
        if rigid_fault(pose) is not None:
            raise ValueError
        return pose
    except ValueError:
        raise UserError(f"{path}: has a damaged frame comment, {marked[0]!r}; export it again") from None


def _activated(
    columns: dict[str, np.ndarray], pose: Float32[np.ndarray, "4 4"] | None, path: Path
) -> "mien.gaussians.Gaussians":
    import torch

    from mien.gaussians import Gaussians

    def read(*names: str) -> torch.Tensor:
        return torch.from_numpy(stacked(columns, list(names), path))

    gaussians = Gaussians(
        means=read("x", "y", "z"), quats=read(*(f"rot_{i}" for i in range(4))),
        scales=read(*(f"scale_{i}" for i in range(3))).exp(), opacities=torch.sigmoid(read("opacity")[:, 0]),
        sh=torch.from_numpy(stacked_sh(columns, path)), T_world_local=None if pose is None else torch.from_numpy(pose),
    )  # fmt: skip
    for word, name in _WORDS.items():
        if not getattr(gaussians, name).isfinite().all():
            raise UserError(f"{path}: the {word} of some Gaussians is NaN or infinite; export it again, or clean it up")
    return gaussians


def write(path: Path, content: Content, options: PlyOptions) -> str:
    """Write the file, and return what is told of it."""
    write_ply(path, options.pose(content), options.sh)
    return pose_words(path, content)
