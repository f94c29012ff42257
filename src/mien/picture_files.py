"""Many pictures of one size: written one after the other, read as an array that does not fill the memory."""

import contextlib
import math
import mmap
import os
import struct
import tempfile
import weakref
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.errors import UserError
from mien.files import cannot_write
from mien.inside import open_to_read

_KEPT = 256 << 20
"""Bytes of a map that are handed out before its pages are given back, and of a stack that are held in memory."""
_PNG_SIGNATURE, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_PNG_HEADERS = 1 << 16
"""Bytes of a file beside those of its pixels, at most."""
_DONT_NEED = getattr(mmap, "MADV_DONTNEED", None)
"""None where the system cannot be told (Windows)."""


class _Tally:
    """Bytes handed out by a map and all of its views."""

    def __init__(self) -> None:
        self.handed_out = 0


class PictureMap(np.memmap):
    """A read-only memory map that gives its pages back to the system now and then.

    What was looked at once stays in a plain map's share of the process's memory, up to the whole file. Pages that are
    given back are read again when they are looked at again, mostly from the system's cache of files.
    """

    _tally: _Tally | None = None

    def __array_finalize__(self, obj: Any) -> None:
        """Views count with what they are views of."""
        super().__array_finalize__(obj)
        self._tally = getattr(obj, "_tally", None)

    def __getitem__(self, index: Any) -> Any:
        """As of any array."""
        found = super().__getitem__(index)
        if isinstance(found, np.ndarray) and self._tally is not None:
            self._tally.handed_out += found.nbytes
            if self._tally.handed_out > _KEPT:
                self._tally.handed_out = 0
                self._give_back()
        return found

    def _give_back(self) -> None:
        pages = getattr(self, "_mmap", None)
        if pages is not None and _DONT_NEED is not None:
            pages.madvise(_DONT_NEED)


def map_pictures(file: Any, shape: tuple[int, ...]) -> PictureMap:
    """The pictures [..., h, w] or [..., h, w, 3] in a raw file (a path, or an open file)."""
    pictures = cast(PictureMap, PictureMap(file, np.uint8, "r", shape=shape))
    pictures._tally = _Tally()
    return pictures


class PictureStack:
    """Pictures that are written in any order and read as one array: in memory while they are few, else on disk.

    The file has no name, and goes with the array.
    """

    def __init__(self, shape: tuple[int, ...], folder: Path | None = None) -> None:
        """`shape` is that of the array, [t, c, h, w]; `folder` is where there is room for it, by default the system's.

        Raises:
            CannotWriteError: the folder cannot be written to.
        """
        self._shape, self._folder = shape, folder or Path(tempfile.gettempdir())
        self._file = None
        if math.prod(shape) <= _KEPT:
            self._array = np.zeros(shape, np.uint8)
            return
        try:
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (it lives as long as this)
            weakref.finalize(self, self._file.close)
            os.truncate(self._file.fileno(), math.prod(shape))
        except OSError as error:
            raise cannot_write(self._folder, error) from None

    def write(self, timestep: int, camera: int, picture: UInt8[np.ndarray, "h w"]) -> None:
        """Put one picture in its place.

        Raises:
            CannotWriteError: the disk is full.
        """
        if self._file is None:
            self._array[timestep, camera] = picture
            return
        try:
            # Through a memory map a full disk would be a crash, not an error.
            write_at(self._file.fileno(), picture, (timestep * self._shape[1] + camera) * picture.nbytes)
        except OSError as error:
            raise cannot_write(self._folder, error) from None

    def array(self) -> UInt8[np.ndarray, "t c h w"]:
        """All pictures; zero where none was written."""
        return self._array if self._file is None else map_pictures(self._file, self._shape)


def decode_png(path: Path, shape: tuple[int, ...], remedy: str) -> UInt8[np.ndarray, "..."]:
    """A picture that mien wrote inside a workspace, [h, w] or [h, w, 3] (RGB); its header's size is looked at first.

    Args:
        path: of the file, no link.
        shape: that it has to have.
        remedy: what to do where it has not.

    Raises:
        UserError: it is missing, damaged, or of another shape.
    """
    try:
        with open_to_read(path) as file:
            # Noise takes a little more than its pixels; what is longer than that counts as damaged.
            most = 2 * math.prod(shape) + _PNG_HEADERS
            data = file.read(min(most, os.fstat(file.fileno()).st_size))
    except FileNotFoundError:
        raise UserError(f"{path}: missing; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    if not data.endswith(_PNG_END):
        # Checked here, because libpng would print its complaint and return half a picture.
        raise UserError(f"{path}: truncated; {remedy}")
    picture = None
    # Its width and height stand at the beginning; what they promise would be allocated.
    if data[:8] == _PNG_SIGNATURE and data[16:24] == struct.pack(">II", shape[1], shape[0]):
        with contextlib.suppress(cv2.error):
            flags = cv2.IMREAD_COLOR_RGB if len(shape) == 3 else cv2.IMREAD_GRAYSCALE
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None or picture.shape != shape:
        raise UserError(f"{path}: damaged, or not of {shape[1]}x{shape[0]} pixels; {remedy}")
    return picture.astype(np.uint8, copy=False)


def write_at(file: int, picture: UInt8[np.ndarray, "..."], offset: int) -> None:
    """Write a picture's bytes at a place in an open file.

    Raises:
        OSError: the disk is full.
    """
    data = np.ascontiguousarray(picture).data.cast("B")
    while data:
        written = os.pwrite(file, data, offset)
        data, offset = data[written:], offset + written
