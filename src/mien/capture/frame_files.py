"""Step 4: write frames as lossless PNGs, and beside them the decoded pixels as raw files for memory maps."""

import hashlib
import math
import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.disk.inside import open_new, open_to_change
from mien.errors import UserError
from mien.media.picture_files import decode_png, encode_picture, write_at

FRAMES, MATTES, CACHE = "frames", "mattes", "cache"
STAGE = "`mien capture`"
REMEDY = "run `mien capture` on its video again, which repairs it"
"""Remedy for a damaged capture."""
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    # Plain pip installs OpenCV 4.11 with mediapipe, which cannot choose the filter (docs/platforms.md).
    *((cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP) if hasattr(cv2, "IMWRITE_PNG_FILTER") else ()),
)
"""These options take half the time of OpenCV's default for level 1 and make smaller files."""
_MAX_QUEUED = 8
"""Largest number of timesteps that wait to be written. It bounds the memory."""

MakeFrames = Callable[[], tuple[np.ndarray, np.ndarray]]
"""Computes the images [c, h, w, 3] and mattes [c, h, w] of one timestep, for the cameras that are written."""


@dataclass(frozen=True)
class FrameLayout:
    """Paths of the frames of a capture, and their number and size."""

    folder: Path
    camera_ids: tuple[str, ...]
    timesteps: int
    height: int
    width: int

    def png(self, kind: str, timestep: int, camera: int) -> Path:
        """Path of one frame (`kind` is FRAMES) or matte (MATTES)."""
        return self.folder / kind / self.camera_ids[camera] / f"{timestep:06d}.png"

    def raw(self, kind: str) -> Path:
        """Path of the cache file of all frames or mattes."""
        return self.folder / CACHE / f"{kind}.u8"

    def shape(self, kind: str) -> tuple[int, ...]:
        """Shape of all frames, [t, c, h, w, 3], or mattes, [t, c, h, w]."""
        shape = (self.timesteps, len(self.camera_ids), self.height, self.width)
        return (*shape, 3) if kind == FRAMES else shape

    def raw_size(self, kind: str) -> int:
        """Size of the cache file in bytes."""
        return math.prod(self.shape(kind))


class CacheWriter:
    """Fills the raw files picture by picture, with plain writes: a full disk raises an error instead of crashing."""

    def __init__(self, layout: FrameLayout) -> None:
        """Open the raw files. Their content is kept.

        Raises:
            UserError: a link, a special file or a file with a second name is in the way.
            OSError: the files cannot be written.
        """
        self._layout = layout
        (layout.folder / CACHE).mkdir(parents=True, exist_ok=True)
        self._files = {}
        try:
            for kind in (FRAMES, MATTES):
                self._files[kind] = open_to_change(layout.raw(kind))
                os.truncate(self._files[kind], layout.raw_size(kind))
        except BaseException:
            self.close()
            raise

    def write(self, kind: str, timestep: int, camera: int, picture: np.ndarray) -> None:
        """Write one picture at its position."""
        index = timestep * len(self._layout.camera_ids) + camera
        write_at(self._files[kind], picture, index * picture.nbytes)

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            os.close(file)


class FrameWriter:
    """Writes frames and mattes as PNGs and into the cache, on one thread beside the caller's. Use as a context manager.

    Files of an earlier, interrupted run are overwritten frame by frame.
    """

    def __init__(self, layout: FrameLayout, camera: int | None = None) -> None:
        """Prepare to write the pictures of all cameras, or of the one with this index."""
        self.layout = layout
        self._cameras = range(len(layout.camera_ids)) if camera is None else (camera,)
        shape = (layout.timesteps, len(layout.camera_ids))
        self.digests = {kind: np.zeros(shape, np.uint64) for kind in (FRAMES, MATTES)}
        """Digest of each picture written so far."""
        self._pending: deque[Future[None]] = deque()

    def __enter__(self) -> "FrameWriter":
        for kind in (FRAMES, MATTES):
            for camera in self._cameras:
                self.layout.png(kind, 0, camera).parent.mkdir(parents=True, exist_ok=True)
        self._cache = CacheWriter(self.layout)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="frame-writer")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._thread.shutdown(wait=True, cancel_futures=error is not None)
        self._cache.close()

    def submit(self, timestep: int, make: MakeFrames) -> None:
        """Queue one timestep, whose pictures `make` computes on the writing thread. Waits if too many are queued.

        Raises:
            OSError: an earlier timestep could not be written.
        """
        while len(self._pending) >= _MAX_QUEUED:
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(self._write, timestep, make))

    def flush(self) -> None:
        """Wait until everything queued is written.

        Raises:
            OSError: a timestep could not be written.
        """
        while self._pending:
            self._pending.popleft().result()

    def _write(self, timestep: int, make: MakeFrames) -> None:
        for kind, pictures in zip((FRAMES, MATTES), make(), strict=True):
            expected = (len(self._cameras), *self.layout.shape(kind)[2:])
            assert pictures.shape == expected, (kind, pictures.shape, self.layout)
            for camera, picture in zip(self._cameras, pictures, strict=True):
                picture = np.ascontiguousarray(picture)
                self.digests[kind][timestep, camera] = picture_digest(picture)
                _write_png(self.layout.png(kind, timestep, camera), picture)
                self._cache.write(kind, timestep, camera, picture)


def picture_digest(picture: UInt8[np.ndarray, "..."]) -> int:
    """Return 64 bits of a hash over the pixels."""
    return int.from_bytes(hashlib.sha256(picture.data.cast("B")).digest()[:8], "little")


def read_png(path: Path, shape: tuple[int, ...], expected_digest: int) -> UInt8[np.ndarray, "..."]:
    """Read one picture and check its pixels."""
    picture = decode_png(path, shape, REMEDY)
    if picture_digest(picture) != expected_digest:
        raise UserError(f"{path}: its pixels have changed since it was captured; {REMEDY}")
    return picture


def _write_png(path: Path, picture: np.ndarray) -> None:
    data = encode_picture(picture, options=PNG_OPTIONS)
    with open_new(path) as file:
        file.write(data)
