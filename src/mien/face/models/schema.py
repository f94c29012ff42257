"""What readers of face models share: checks of a user's arrays, and tensors for a `FaceModel`."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Bool, Float

from mien.errors import UserError

LARGEST_COEFFICIENT = 3.0  # bound of an expression coefficient in standard deviations, as FLAME and GNM have them
IRIS_RADIUS = 0.0061  # radius of the iris in metres. Anatomy: it hardly differs between people
_MIN_HEIGHT, _MAX_HEIGHT = 0.1, 0.6  # range of the height of a head with its neck, in metres
_MAX_NUMBER = 1e6  # bound of all numbers in a file: metres, weights and indices


def check_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    shapes: Mapping[str, str],
    missing: str,
    remedy: str,
    known: Mapping[str, int] = MappingProxyType({}),
) -> dict[str, int]:
    """Check shapes and numbers of arrays, and return the sizes that the letters stand for.

    `shapes` are such as "v 3": a letter is the same size wherever it stands, also in the `known` sizes. `missing` is
    said of an array that is missing.
    """
    sizes = dict(known)
    for key in shapes:
        if key not in arrays:
            raise UserError(f"{path}: has no {key!r}, so {missing}")
    for key, shape in shapes.items():
        array, symbols = arrays[key], shape.split()
        fits = array.ndim == len(symbols) and array.dtype.kind in "iuf"
        for size, symbol in zip(array.shape, symbols, strict=False):
            fits = fits and size > 0 and size == (int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size))
        if not fits:
            wanted = ", ".join(str(sizes.get(symbol, symbol)) for symbol in symbols)
            raise UserError(
                f"{path}: {key!r} has the shape {list(array.shape)} of {array.dtype}, not [{wanted}] of numbers; "
                f"{remedy}"
            )
        check_numbers(path, key, array, remedy)
    return sizes


def check_numbers(path: Path, key: str, array: np.ndarray, remedy: str = "download it again") -> None:
    """Check that the numbers of an array are finite and moderate."""
    if array.dtype.kind != "f":
        return
    if not np.isfinite(array).all():
        raise UserError(f"{path}: {key!r} holds numbers that are not finite; {remedy}")
    largest = max(float(array.max(initial=0)), -float(array.min(initial=0)))
    if largest > _MAX_NUMBER:
        raise UserError(f"{path}: {key!r} holds {largest:g}, but a head has no number above {_MAX_NUMBER:g}; {remedy}")


def check_indices(path: Path, key: str, values: np.ndarray, count: int) -> np.ndarray:
    """Return indices as int64, after a check that each is below `count`."""
    values = values.astype(np.int64)
    if values.min() < 0 or values.max() >= count:
        raise UserError(
            f"{path}: {key!r} has the index {values.max()}, but only {count} entries exist; download it again"
        )
    return values


def check_head(
    path: Path, names: tuple[str, str], template: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v k"]
) -> None:
    """Check what shapes do not show: the unit of the template, and that weights add up. `names` are theirs."""
    height = float(np.ptp(template[:, 1]))
    if not _MIN_HEIGHT < height < _MAX_HEIGHT:
        raise UserError(
            f"{path}: {names[0]!r} is {height:g} high, but a head in metres with y upwards is {_MIN_HEIGHT:g} to "
            f"{_MAX_HEIGHT:g} high: scale it together with its bases, or download it again"
        )
    if not np.allclose(weights.sum(1), 1, atol=1e-3) or weights.min() < -1e-6:
        raise UserError(f"{path}: {names[1]!r} of a vertex do not add up to 1 or are negative; download it again")


def float_tensor(values: np.ndarray) -> torch.Tensor:
    """Return values as float32."""
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def rounded(values: np.ndarray, quantum: float = 1e-7) -> torch.Tensor:
    """Round computed values, in metres. Their last digits depend on the machine and would change the content hash."""
    # Adding 0 turns -0 into 0, whose bytes differ.
    return float_tensor(np.round(values / quantum) * quantum + 0.0)


def in_iris(template: Float[np.ndarray, "v 3"], center: Float[np.ndarray, " 3"]) -> Bool[np.ndarray, " v"]:
    """Return which vertices are on the iris of the eyeball with this centre, which looks ahead, or before it."""
    rays = template - center
    return (rays[:, 2] > 0) & (np.hypot(rays[:, 0], rays[:, 1]) < IRIS_RADIUS)
