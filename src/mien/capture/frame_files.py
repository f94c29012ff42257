"""Frames on disk: lossless PNGs, and beside them the decoded pixels as raw files that are read as memory maps."""

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

from mien.errors import UserError
from mien.inside import open_new, open_to_change
from mien.picture_files import decode_png, write_at

FRAMES, MATTES, CACHE = "frames", "mattes", "cache"
STAGE = "`mien capture`"
REMEDY = "run `mien capture` on its video again, which mends it"
"""For damaged captures."""
_PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
)
"""Half the time of OpenCV's default for level 1, and smaller files."""
_IN_FLIGHT = 8
"""Timesteps that wait for the disk at most: bounds the memory."""

MakeFrames = Callable[[], tuple[np.ndarray, np.ndarray]]
"""Computes the images [c, h, w, 3] and mattes [c, h, w] of a timestep."""


@dataclass(frozen=True)
class FrameLayout:
    """Where the frames of a capture lie, and how many there are."""

    folder: Path
    camera_ids: tuple[str, ...]
    timesteps: int
    height: int
    width: int

    def png(self, kind: str, timestep: int, camera: int) -> Path:
        """The file of one frame (`kind` is FRAMES) or matte (MATTES)."""
        return self.folder / kind / self.camera_ids[camera] / f"{timestep:06d}.png"

    def raw(self, kind: str) -> Path:
        """The cache file of all frames or mattes."""
        return self.folder / CACHE / f"{kind}.u8"

    def shape(self, kind: str) -> tuple[int, ...]:
        """Of all frames, [t, c, h, w, 3], or mattes, [t, c, h, w]."""
        shape = (self.timesteps, len(self.camera_ids), self.height, self.width)
        return (*shape, 3) if kind == FRAMES else shape

    def raw_size(self, kind: str) -> int:
        """Bytes of the cache file."""
        return math.prod(self.shape(kind))


class CacheWriter:
    """Fills the raw files picture by picture, by plain writes: a full disk is an error then, not a crash."""

    def __init__(self, layout: FrameLayout) -> None:
        """What the files hold already is kept.

        Raises:
            UserError: something there is a link, no file, or has a second name.
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
        """Put one picture in its place."""
        index = timestep * len(self._layout.camera_ids) + camera
        write_at(self._files[kind], picture, index * picture.nbytes)

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            os.close(file)


class FrameWriter:
    """Writes frames and mattes as PNGs and into the cache, on one thread beside the caller's. A context manager.

    Files of an earlier, interrupted run are overwritten frame by frame.
    """

    def __init__(self, layout: FrameLayout) -> None:
        self.layout = layout
        shape = (layout.timesteps, len(layout.camera_ids))
        self.digests = {kind: np.zeros(shape, np.uint64) for kind in (FRAMES, MATTES)}
        """Of each picture written so far."""
        self._pending: deque[Future[None]] = deque()

    def __enter__(self) -> "FrameWriter":
        for kind in (FRAMES, MATTES):
            for camera_id in self.layout.camera_ids:
                (self.layout.folder / kind / camera_id).mkdir(parents=True, exist_ok=True)
        self._cache = CacheWriter(self.layout)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="frame-writer")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._thread.shutdown(wait=True, cancel_futures=error is not None)
        self._cache.close()

    def submit(self, timestep: int, make: MakeFrames) -> None:
        """Queue one timestep, whose pictures `make` computes on the writing thread; waits while too many are queued.

        Raises:
            OSError: something queued before could not be written.
        """
        while len(self._pending) >= _IN_FLIGHT:
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(self._write, timestep, make))

    def flush(self) -> None:
        """Wait until everything queued is written.

        Raises:
            OSError: something could not be written.
        """
        while self._pending:
            self._pending.popleft().result()

    def _write(self, timestep: int, make: MakeFrames) -> None:
        for kind, pictures in zip((FRAMES, MATTES), make(), strict=True):
            assert pictures.shape == self.layout.shape(kind)[1:], (kind, pictures.shape, self.layout)
            for camera, picture in enumerate(pictures):
                picture = np.ascontiguousarray(picture)
                self.digests[kind][timestep, camera] = picture_digest(picture)
                _write_png(self.layout.png(kind, timestep, camera), picture)
                self._cache.write(kind, timestep, camera, picture)


def picture_digest(picture: UInt8[np.ndarray, "..."]) -> int:
    """64 bits of a hash over the pixels."""
    return int.from_bytes(hashlib.sha256(picture.data.cast("B")).digest()[:8], "little")


def read_png(path: Path, shape: tuple[int, ...], expected_digest: int) -> UInt8[np.ndarray, "..."]:
    """One picture, checked.

    Raises:
        UserError: it is missing, damaged, or not what was written.
    """
    picture = decode_png(path, shape, REMEDY)
    if picture_digest(picture) != expected_digest:
        raise UserError(f"{path}: has other pixels than when it was captured; {REMEDY}")
    return picture


def _write_png(path: Path, picture: np.ndarray) -> None:
    stored = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    written, data = cv2.imencode(".png", stored, _PNG_OPTIONS)
    assert written
    with open_new(path) as file:
        file.write(data.tobytes())
