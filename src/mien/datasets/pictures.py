"""Pictures of a dataset, read one by one into arrays on disk, so that long sequences do not have to fit into memory."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.datasets.content import REMEDY
from mien.errors import UserError
from mien.machine.progress import progress_bar
from mien.media.decoding import decode_picture

Pixels = UInt8[np.ndarray, "h w 3"]
Matte = UInt8[np.ndarray, "h w"]
ReadFrame = Callable[[int, int], tuple[Pixels, Matte]]
"""Returns picture and matte of a timestep and a camera."""


def read_picture(path: Path, size: tuple[int, int] | None = None) -> tuple[Pixels, Matte | None]:
    """Read the colours of an 8-bit picture, and its opacity if it has a fourth channel."""
    pixels = decode_picture(path, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint8 or (pixels.ndim == 3 and pixels.shape[2] not in (1, 3, 4)):
        raise UserError(f"{path}: cannot be read as a picture of 8 bits a channel; {REMEDY}")
    _check_size(path, pixels, size)
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2), None
    matte = np.ascontiguousarray(pixels[..., 3]) if pixels.shape[2] == 4 else None
    return np.ascontiguousarray(pixels[..., 2::-1]), matte


def read_matte(path: Path, size: tuple[int, int]) -> Matte:
    """Read a grey picture of opacities. Of a coloured one, the first channel counts."""
    return np.ascontiguousarray(read_picture(path, size)[0][..., 0])


def _check_size(path: Path, pixels: np.ndarray, size: tuple[int, int] | None) -> None:
    height, width = pixels.shape[:2]
    if size is not None and (width, height) != size:
        raise UserError(f"{path}: has {width}x{height} pixels, not {size[0]}x{size[1]} as its cameras say; {REMEDY}")


def collect(
    timesteps: int, cameras: int, size: tuple[int, int], read: ReadFrame, title: str
) -> tuple[UInt8[np.ndarray, "t c h w 3"], UInt8[np.ndarray, "t c h w"]]:
    """Read all pictures and mattes into arrays on disk, which vanish with the last reference to them.

    Args:
        timesteps: Number of timesteps.
        cameras: Number of cameras.
        size: Width and height of all pictures.
        read: The function that reads one picture.
        title: Title of the progress bar.
    """
    shape = (timesteps, cameras, size[1], size[0])
    images, mattes = _on_disk((*shape, 3)), _on_disk(shape)
    with progress_bar(title, timesteps) as advance:
        for timestep in range(timesteps):
            for camera in range(cameras):
                images[timestep, camera], mattes[timestep, camera] = read(timestep, camera)
            advance()
    return images, mattes


def _on_disk(shape: tuple[int, ...]) -> np.ndarray:
    with tempfile.TemporaryFile(prefix="mien-import-") as file:
        try:
            # Reserved at once, because a full disk would end the process when the array is written.
            os.posix_fallocate(file.fileno(), 0, int(np.prod(shape, dtype=np.int64)))
        except OSError as error:
            raise UserError(
                f"{tempfile.gettempdir()}: has no place for {np.prod(shape, dtype=np.int64) / 1e9:.1f} GB of pictures "
                f"({error.strerror}); free some, or set TMPDIR to another folder"
            ) from None
        return np.asarray(np.memmap(file, np.uint8, "r+", shape=shape))
