"""Pictures of a dataset, read one by one into arrays on disk, so that long sequences do not have to fit into memory."""

import os
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.capture.person.matte import Segmenter, refine_matte
from mien.capture.person.plate import plate_matte
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
    height, width = pixels.shape[:2]
    if size is not None and (width, height) != size:
        raise UserError(f"{path}: has {width}x{height} pixels, not {size[0]}x{size[1]} as its cameras say; {REMEDY}")
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2), None
    matte = np.ascontiguousarray(pixels[..., 3]) if pixels.shape[2] == 4 else None
    return np.ascontiguousarray(pixels[..., 2::-1]), matte


def read_matte(path: Path, size: tuple[int, int]) -> Matte:
    """Read a grey picture of opacities. Of a coloured one, the first channel counts."""
    return np.ascontiguousarray(read_picture(path, size)[0][..., 0])


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture."""
    height, width = read_picture(path)[0].shape[:2]
    return width, height


def read_one_camera(
    places: Sequence[Path], name: str, matte_of: Callable[[int, Matte | None, tuple[int, int]], Matte] | None,
    plate: Path | None = None,
) -> tuple[UInt8[np.ndarray, "t 1 h w 3"], UInt8[np.ndarray, "t 1 h w"]]:  # fmt: skip
    """Read the pictures of one camera, and their mattes.

    `places` are in the order of time, and all have the size of the first. `matte_of` returns the matte of a timestep,
    by the opacity in its picture, if any, and the size. If it is None, mien makes the mattes, more exactly with
    `plate`, a picture of the empty scene.
    """
    size = picture_size(places[0])

    def read(timestep: int, camera: int) -> tuple[Pixels, Matte]:
        colors, opacity = read_picture(places[timestep], size)
        empty = np.zeros((size[1], size[0]), np.uint8)
        return colors, empty if matte_of is None else matte_of(timestep, opacity, size)

    images, mattes = collect(len(places), 1, size, read, f"read {name}")
    if matte_of is None:
        fill_mattes(images, mattes, None if plate is None else read_picture(plate, size)[0])
    return images, mattes


def collect(
    timesteps: int, cameras: int, size: tuple[int, int], read: ReadFrame, title: str
) -> tuple[UInt8[np.ndarray, "t c h w 3"], UInt8[np.ndarray, "t c h w"]]:
    """Read all pictures and mattes into arrays on disk, which vanish with the last reference to them."""
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


def fill_mattes(
    images: UInt8[np.ndarray, "t c h w 3"],
    mattes: UInt8[np.ndarray, "t c h w"],
    plate: UInt8[np.ndarray, "h w 3"] | None = None,
) -> None:
    """Write the opacity of the person in each picture into `mattes`, by the network of `mien capture`; 255 is whole.

    `plate` is a picture of the scene without the person, from the same place.
    """
    refine = refine_matte if plate is None else partial(plate_matte, plate=plate)
    for camera in range(images.shape[1]):
        with Segmenter() as segmenter, progress_bar("matting", len(images)) as advance:
            for timestep in range(len(images)):
                picture = np.ascontiguousarray(images[timestep, camera])
                mattes[timestep, camera] = refine(picture, segmenter.segment(picture))
                advance()
