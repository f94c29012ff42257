"""Read arrays of a user's .npz file. The announced size of a member is checked before memory is allocated.

`numpy.load` trusts the headers, and a member of 6 MB may unpack to gigabytes.
"""

import io
import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mien.disk.reading import open_archive, open_member, open_ordinary
from mien.errors import UserError

MAX_MODEL_BYTES = 256 << 20
"""Largest size of all arrays of a face model together, in bytes. FLAME 2023 has 60 MB."""
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
_ENDING = ".npy"
_NUMBERS = "biuf"  # kinds of plain numbers, by numpy's letters


@contextmanager
def readable(path: Path, kind: str, remedy: str) -> Iterator[None]:
    """Tell in one line why a user's file cannot be read as what it should be, whatever is wrong with it."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{path}: is missing; {remedy}") from None
    except Exception as error:  # a damaged file may fail in any way
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{path}: cannot be read as {kind} ({reason}); {remedy}") from None


def read_npz(
    path: Path, wanted: Collection[str], texts: Collection[str] = ()
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return the names of all members of an .npz, and its wanted arrays of plain numbers.

    Those that `texts` names may hold texts of a fixed length instead. A damaged file raises any error: `readable`.
    """
    with open_ordinary(path) as file, open_archive(file) as archive:
        members = archive.infolist()
        names = [member.filename.removesuffix(_ENDING) for member in members]
        arrays: dict[str, np.ndarray] = {}
        left = MAX_MODEL_BYTES
        for name, member in zip(names, members, strict=True):
            if name not in wanted:
                continue
            if name in arrays:
                raise ValueError(f"{name!r} occurs twice")
            try:
                with open_member(archive, member) as content:
                    arrays[name] = _read_array(content, left, _NUMBERS + "U" if name in texts else _NUMBERS)
            except ValueError as error:
                raise ValueError(f"{name!r}: {error}") from None
            left -= arrays[name].nbytes
    return names, arrays


def parse_npy(data: bytes) -> np.ndarray:
    """Return the array of plain numbers in the bytes of an .npy file."""
    return _read_array(io.BytesIO(data), len(data))


def _read_array(file: io.BufferedIOBase, limit: int, kinds: str = _NUMBERS) -> np.ndarray:
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"is of version {version} of numpy's format")
    shape, by_column, kind = _HEADERS[version](file)
    if kind.kind not in kinds:
        raise ValueError(f"holds {kind}, not plain numbers")
    size = math.prod(shape) * kind.itemsize
    if not all(length >= 0 for length in shape):
        raise ValueError(f"has the shape {shape}")
    if size > limit:
        raise ValueError(f"has {size:,} bytes; the arrays of a face model have at most {MAX_MODEL_BYTES:,} together")
    data = file.read(size)
    # Reading to the end makes zipfile compare the checksum.
    if len(data) != size or file.read(1):
        raise ValueError("is not as long as its header states")
    values = np.frombuffer(data, kind).reshape(shape, order="F" if by_column else "C")
    return values.astype(kind.newbyteorder("="))
