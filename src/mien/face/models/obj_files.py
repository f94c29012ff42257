"""Read positions and faces of .obj files, as ICT-FaceKit has them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mien.disk.reading import read_bytes
from mien.errors import UserError

_MAX_BYTES = 64 << 20
"""Limit of a file, in bytes. Those of ICT-FaceKit have 3 MB."""


def read_obj(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "q 4"]]:
    """Return positions and faces of three or four corners; -1 is the last corner of a triangle."""
    lines = _lines(path)
    with _Told(path):
        corners = [[int(part.split(b"/")[0]) - 1 for part in line.split()[1:]] for line in lines if line[:2] == b"f "]
        if not corners or not all(len(each) in (3, 4) for each in corners):
            raise ValueError("its faces do not have three or four corners")
        return _positions(lines), np.array([(*each, -1)[:4] for each in corners], np.int64)


def read_obj_positions(path: Path, count: int) -> Float[np.ndarray, "v 3"]:
    """Return the positions of a file that has `count` of them."""
    lines = _lines(path)
    with _Told(path):
        positions = _positions(lines)
        if len(positions) != count:
            raise ValueError(f"{len(positions):,} vertices instead of {count:,}")
        return positions


class _Told:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (ValueError, OverflowError)):
            reason = " ".join(str(error).split())[:200]
            raise UserError(f"{self.path}: cannot be read as .obj ({reason}); download it again") from None


def _lines(path: Path) -> list[bytes]:
    try:
        return read_bytes(path, _MAX_BYTES).splitlines()
    except (OSError, ValueError, MemoryError) as error:
        raise UserError(f"{path}: cannot be read as .obj ({error}); download it again") from None


def _positions(lines: list[bytes]) -> Float[np.ndarray, "v 3"]:
    rows: Iterator[list[bytes]] = (line.split()[1:4] for line in lines if line[:2] == b"v ")
    positions = np.array([[float(value) for value in row] for row in rows])
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError("a vertex does not have three coordinates")
    return positions
