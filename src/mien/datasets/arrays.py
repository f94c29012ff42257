"""Arrays in the files of strangers: nothing in them is run, their size is limited, and their shapes are checked."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from mien.datasets.content import REMEDY
from mien.disk.limits import MAX_NUMBER
from mien.disk.reading import read_bytes
from mien.errors import UserError
from mien.face.models.npz import parse_npy, read_npz, readable


def read_arrays(path: Path, axes: Mapping[str, str], sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Return arrays of an .npz by name. Floating point numbers become float32, and other types stay.

    `axes` has a letter for each axis of each array, such as "tyx3". Axes of one letter are equally long, and a digit is
    a length. `sizes` are lengths that are known, by letter.
    """
    with readable(path, ".npz", REMEDY):
        arrays = read_npz(path, tuple(axes))[1]
    known = {**{str(digit): digit for digit in range(10)}, **sizes}
    for name, letters in axes.items():
        if name not in arrays:
            raise UserError(f"{path}: has no {name!r}; {REMEDY}")
        shape = arrays[name].shape
        expected = [known.setdefault(letter, size) for letter, size in zip(letters, shape, strict=False)]
        if len(letters) != len(shape) or list(shape) != expected or 0 in shape:
            raise UserError(
                f"{path}: {name!r} has the shape {list(shape)}, which is not [{', '.join(letters)}]; {REMEDY}"
            )
    return {name: each.astype(np.float32) if each.dtype.kind == "f" else each for name, each in arrays.items()}


def read_npy(path: Path) -> np.ndarray:
    """Return the array of an .npy file of plain numbers."""
    with readable(path, ".npy", REMEDY):
        return parse_npy(read_bytes(path, 16 << 20))


def read_some_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Return those of the named arrays of an .npz that it has, as float64, after a check of their numbers."""
    with readable(path, ".npz", REMEDY):
        arrays = read_npz(path, names)[1]
    for name, array in arrays.items():
        if array.size and not np.abs(array.astype(np.float64)).max() <= MAX_NUMBER:
            raise UserError(f"{path}: {name!r} holds NaN or numbers beyond {MAX_NUMBER:g}; {REMEDY}")
    return {name: array.astype(np.float64) for name, array in arrays.items()}
