"""Many pictures of one size: written one by one, and read as an array that does not fill the memory."""

import contextlib
import math
import mmap
import os
import struct
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.disk.files import cannot_write, write_atomically
from mien.disk.reading import open_to_read
from mien.errors import UserError
from mien.machine import system

MAX_MAPPED_BYTES = 32 << 20
"""Number of bytes that a map hands out before it gives its pages back."""
MAX_HELD_BYTES = 64 << 20
"""Size of the largest stack that is held in memory."""
_PNG_SIGNATURE, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_DONT_NEED = getattr(mmap, "MADV_DONTNEED", None)  # None if the system has no such call (Windows)


class PictureMap(np.memmap):
    """A read-only memory map that gives its pages back to the system now and then.

    In a plain map, every page that was read once stays in the process's memory, up to the whole file. Pages that were
    given back are read again when they are needed, mostly from the system's file cache.
    """

    _handed_out: list[int] | None = None
    """The bytes that the map and all of its views have handed out, as one number."""

    def __array_finalize__(self, obj: Any) -> None:
        super().__array_finalize__(obj)
        self._handed_out = getattr(obj, "_handed_out", None)

    def __getitem__(self, index: Any) -> Any:
        found = super().__getitem__(index)
        if isinstance(found, np.ndarray) and self._handed_out is not None:
            self._handed_out[0] += found.nbytes
            if self._handed_out[0] > MAX_MAPPED_BYTES:
                self._handed_out[0] = 0
                pages = getattr(self, "_mmap", None)
                if pages is not None and _DONT_NEED is not None:
                    pages.madvise(_DONT_NEED)
        return found


def map_pictures(file: Any, shape: tuple[int, ...]) -> PictureMap:
    """Map the pictures [..., h, w] or [..., h, w, 3] in a raw file, given as a path or an open file."""
    pictures = cast(PictureMap, PictureMap(file, np.uint8, "r", shape=shape))
    pictures._handed_out = [0]
    return pictures


class PictureStack:
    """Pictures written in any order and read as one array: a small one in memory, a large one in an unnamed file."""

    def __init__(self, shape: tuple[int, ...], folder: Path | None = None) -> None:
        """Make room for an array of the given `shape`, [t, c, h, w].

        A large array is in `folder`, by default in the system's folder for temporary files.
        """
        self._shape, self._folder = shape, folder or Path(tempfile.gettempdir())
        self._file = None
        if math.prod(shape) <= MAX_HELD_BYTES:
            self._array = np.zeros(shape, np.uint8)
            return
        try:
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (open as long as this object lives)
            weakref.finalize(self, self._file.close)
            os.truncate(self._file.fileno(), math.prod(shape))
        except OSError as error:
            raise cannot_write(self._folder, error) from None

    def write(self, timestep: int, camera: int, picture: UInt8[np.ndarray, "h w"]) -> None:
        """Write one picture to its place."""
        if self._file is None:
            self._array[timestep, camera] = picture
            return
        try:
            # A write through a memory map would crash on a full disk, not raise an error.
            write_at(self._file.fileno(), picture, (timestep * self._shape[1] + camera) * picture.nbytes)
        except OSError as error:
            raise cannot_write(self._folder, error) from None

    def array(self) -> UInt8[np.ndarray, "t c h w"]:
        """All pictures. Pictures that were not written are zero."""
        return self._array if self._file is None else map_pictures(self._file, self._shape)


def png_fits(data: bytes) -> bool:
    """Whether the chunks of a PNG lie within its bytes. A decoder takes memory for the length that each announces."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = int.from_bytes(data[position : position + 4], "big"), data[position + 4 : position + 8]
        position += 12 + length
        if position > len(data):
            return False
        if kind == b"IEND":
            return True
    return False


def encode_picture(picture: UInt8[np.ndarray, "h w *c"], ending: str = ".png", options: Sequence[int] = ()) -> bytes:
    """The content of a picture file, for a grey, an RGB or an RGBA picture. `options` are those of `cv2.imencode`."""
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    encoded, data = cv2.imencode(ending, picture, options)
    assert encoded, f"cannot encode a picture of shape {picture.shape}"
    return data.tobytes()


def write_png(path: Path, picture: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write one grey, RGB or RGBA picture atomically."""
    data = encode_picture(picture)
    write_atomically(path, lambda aside: aside.write_bytes(data))


def decode_png(path: Path, shape: tuple[int, ...], remedy: str) -> UInt8[np.ndarray, "..."]:
    """Read a picture that mien wrote inside a workspace, [h, w] or [h, w, 3] (RGB). Its header is checked first."""
    try:
        with open_to_read(path) as file:
            # A PNG of noise is a little larger than its pixels; a file that is much longer counts as damaged.
            most = 2 * math.prod(shape) + (1 << 16)
            data = file.read(min(most, os.fstat(file.fileno()).st_size))
    except FileNotFoundError:
        raise UserError(f"{path}: missing; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    if not data.endswith(_PNG_END):
        # Check the end here, because libpng would only print a complaint and return half a picture.
        raise UserError(f"{path}: truncated; {remedy}")
    picture = None
    # Check the width and height in the header first, because the decoder would allocate them.
    if data[:8] == _PNG_SIGNATURE and png_fits(data) and data[16:24] == struct.pack(">II", shape[1], shape[0]):
        with contextlib.suppress(cv2.error):
            flags = cv2.IMREAD_COLOR_RGB if len(shape) == 3 else cv2.IMREAD_GRAYSCALE
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None or picture.shape != shape:
        raise UserError(f"{path}: damaged, or not of {shape[1]}x{shape[0]} pixels; {remedy}")
    return picture.astype(np.uint8, copy=False)


def write_at(file: int, picture: UInt8[np.ndarray, "..."], offset: int) -> None:
    """Write a picture's bytes at an offset in an open file."""
    data = np.ascontiguousarray(picture).data.cast("B")
    while data:
        written = system.write_at(file, data, offset)
        data, offset = data[written:], offset + written
