"""Masks of clothes in the pictures of imported sequences are kept here, for protocols that score without them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from mien.disk.files import read_tensors
from mien.errors import UserError

FOREIGN = "foreign.safetensors"
"""File of a sequence with arrays of its dataset for which mien has no place of its own."""
CLOTHES = "clothes"
"""Name of the packed masks in it."""
_REMEDY = "import the sequence again"


def packed_clothes(masks: Bool[np.ndarray, "t h w"]) -> dict[str, UInt8[np.ndarray, "t h p"]]:
    """Return masks of clothes as they are kept beside a capture, eight pixels a byte."""
    return {CLOTHES: np.packbits(masks, axis=2)}


def read_clothes(folder: Path, shape: tuple[int, int, int]) -> UInt8[np.ndarray, "t h p"] | None:
    """Return the packed masks of clothes of a sequence, or None if its dataset has none."""
    file = folder / FOREIGN
    if not file.exists():
        return None
    arrays: Mapping[str, object] = read_tensors(file, remedy=_REMEDY)
    if CLOTHES not in arrays:
        return None
    packed = np.asarray(arrays[CLOTHES])
    timesteps, height, width = shape
    if packed.dtype != np.uint8 or packed.shape != (timesteps, height, -(-width // 8)):
        raise UserError(f"{file}: its masks of clothes do not fit the pictures; {_REMEDY}")
    return packed


def clothes_mask(packed: UInt8[np.ndarray, "t h p"], timestep: int, width: int) -> Bool[np.ndarray, "h w"]:
    """Return the mask of clothes of a picture."""
    return np.unpackbits(packed[timestep], axis=1, count=width).astype(bool)


def clothes_digest(packed: UInt8[np.ndarray, "t h p"]) -> str:
    """Return a hash of the masks, as hex digits."""
    return hashlib.sha256(np.ascontiguousarray(packed).tobytes()).hexdigest()[:16]
