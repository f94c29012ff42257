"""Step 4: write frames as lossless PNGs, and beside them the decoded pixels as raw files for memory maps.

This cache is rebuilt when the capture or one of its PNGs has changed.
"""

import hashlib
import itertools
import math
import os
import tempfile
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from mien.disk.files import read_json, write_json
from mien.disk.locks import BeingWrittenError, hold
from mien.disk.reading import drop_if_shared, open_new, open_to_change, remove_tree
from mien.errors import CannotWriteError, UserError
from mien.machine.progress import progress_bar
from mien.media.picture_files import decode_png, encode_picture, map_pictures, write_at

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

    def blank(self, kind: str) -> np.ndarray:
        """Zeros in the shape of all frames or mattes that take no memory: stands for pictures that are on disk."""
        return np.broadcast_to(np.uint8(0), self.shape(kind))

    def raw_size(self, kind: str) -> int:
        """Size of the cache file in bytes."""
        return math.prod(self.shape(kind))


class CacheWriter:
    """Fills the raw files picture by picture, with plain writes: a full disk raises an error instead of crashing."""

    def __init__(self, layout: FrameLayout) -> None:
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
    """Writes frames and mattes as PNGs and into the cache, on one thread beside the caller's. A context manager."""

    def __init__(self, layout: FrameLayout, camera: int | None = None) -> None:
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

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=kind is not None)
        self._cache.close()

    def submit(self, timestep: int, make: MakeFrames) -> None:
        """Queue one timestep, whose pictures `make` computes on the writing thread. Waits if too many are queued."""
        while len(self._pending) >= 8:  # which bounds the memory
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(self._write, timestep, make))

    def flush(self) -> None:
        """Wait until everything queued is written."""
        while self._pending:
            self._pending.popleft().result()

    def _write(self, timestep: int, make: MakeFrames) -> None:
        for kind, pictures in zip((FRAMES, MATTES), make(), strict=True):
            expected = (len(self._cameras), *self.layout.shape(kind)[2:])
            assert pictures.shape == expected, (kind, pictures.shape, self.layout)
            for camera, picture in zip(self._cameras, pictures, strict=True):
                picture = np.ascontiguousarray(picture)
                self.digests[kind][timestep, camera] = picture_digest(picture)
                data = encode_picture(picture, options=PNG_OPTIONS)
                with open_new(self.layout.png(kind, timestep, camera)) as file:
                    file.write(data)
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


_FORMAT, _VERSION = "mien.capture_cache", 1
_ASIDE_PREFIX = ".making-"


def stamp_cache(layout: FrameLayout, capture_hash: str) -> None:
    """Record that the cache is complete and matches the PNGs."""
    write_json(
        layout.folder / CACHE / "stamp.json", _FORMAT, _VERSION,
        {"capture_hash": capture_hash, "fingerprint": _fingerprint(layout)},
    )  # fmt: skip


def map_frames(layout: FrameLayout, capture_hash: str, digests: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return memory maps of all frames [t, c, h, w, 3] and mattes [t, c, h, w]. A stale cache is rebuilt first."""
    _check_present(layout)
    found = layout if _is_valid(layout, capture_hash) else _rebuild(layout, capture_hash, digests)
    images, mattes = (map_pictures(found.raw(kind), found.shape(kind)) for kind in (FRAMES, MATTES))
    if found is not layout:
        # The maps keep the pages of a scratch folder alive. Nothing else needs its file names.
        remove_tree(found.folder)
    return images, mattes


def _check_present(layout: FrameLayout) -> None:
    expected = {f"{timestep:06d}.png" for timestep in range(layout.timesteps)}
    for kind, camera_id in itertools.product((FRAMES, MATTES), layout.camera_ids):
        folder = layout.folder / kind / camera_id
        found = {entry.name for entry in os.scandir(folder)} if folder.is_dir() else set()
        missing = sorted(expected - found)
        if missing:
            raise UserError(f"{folder / missing[0]}: missing ({len(missing)} of {layout.timesteps} are); {REMEDY}")


def _is_valid(layout: FrameLayout, capture_hash: str) -> bool:
    try:
        stamp = read_json(layout.folder / CACHE / "stamp.json", _FORMAT, _VERSION)
        sizes = [layout.raw(kind).stat().st_size for kind in (FRAMES, MATTES)]
    except (UserError, OSError):
        return False
    return (
        stamp.get("capture_hash") == capture_hash
        and sizes == [layout.raw_size(kind) for kind in (FRAMES, MATTES)]
        and stamp.get("fingerprint") == _fingerprint(layout)
    )


def _fingerprint(layout: FrameLayout) -> str:
    """Hash of the sizes and modification times of the cache and of all PNGs, which is cheap to compute."""
    digest = hashlib.sha256()
    for kind in (FRAMES, MATTES):
        paths: list[Path] = [layout.raw(kind)]
        for camera_id in layout.camera_ids:
            folder = layout.folder / kind / camera_id
            paths += [folder / f"{timestep:06d}.png" for timestep in range(layout.timesteps)]
        for path in paths:
            status = path.stat()
            digest.update(f"{status.st_size} {status.st_mtime_ns};".encode())
    return digest.hexdigest()


def _rebuild(layout: FrameLayout, capture_hash: str, digests: dict[str, np.ndarray]) -> FrameLayout:
    """Decode everything into the cache, or into a scratch folder if the capture's own cache cannot be written now.

    Other processes may have the old cache mapped, so new files are made aside and then renamed. A lock lets only one
    process write at a time.
    """
    for kind in (FRAMES, MATTES):  # A wrong size in `capture.json` fails here, before disk space is allocated.
        read_png(layout.png(kind, 0, 0), layout.shape(kind)[2:], int(digests[kind][0, 0]))
    try:
        drop_if_shared(layout.folder / CACHE)
        with hold(layout.raw(FRAMES)):
            if not _is_valid(layout, capture_hash):
                _replace_cache(layout, digests)
                stamp_cache(layout, capture_hash)
        return layout
    except (OSError, BeingWrittenError):
        scratch = replace(layout, folder=Path(tempfile.mkdtemp(prefix="mien-capture-")))
        try:
            _decode_all(layout, scratch, digests)
        except BaseException as error:
            remove_tree(scratch.folder)
            if isinstance(error, OSError):
                raise CannotWriteError(
                    f"{layout.folder}: no room for the decoded frames ({error.strerror}); free some disk space", error
                ) from None
            raise
        return scratch


def _replace_cache(layout: FrameLayout, digests: dict[str, np.ndarray]) -> None:
    cache = layout.folder / CACHE
    for left in cache.glob(f"{_ASIDE_PREFIX}*"):  # left by a process that was killed
        remove_tree(left)
    for old in (cache / "stamp.json", layout.raw(FRAMES), layout.raw(MATTES)):  # the disk may have no room for both
        old.unlink(missing_ok=True)
    aside = replace(layout, folder=Path(tempfile.mkdtemp(dir=cache, prefix=_ASIDE_PREFIX)))
    try:
        _decode_all(layout, aside, digests)
        for kind in (FRAMES, MATTES):
            aside.raw(kind).replace(layout.raw(kind))
    finally:
        remove_tree(aside.folder)


def _decode_all(source: FrameLayout, target: FrameLayout, digests: dict[str, np.ndarray]) -> None:
    writer = CacheWriter(target)

    def decode(place: tuple[str, int, int]) -> None:
        kind, timestep, camera = place
        path = source.png(kind, timestep, camera)
        picture = read_png(path, source.shape(kind)[2:], int(digests[kind][timestep, camera]))
        writer.write(kind, timestep, camera, np.ascontiguousarray(picture))

    everything = list(itertools.product((FRAMES, MATTES), range(source.timesteps), range(len(source.camera_ids))))
    threads = ThreadPoolExecutor(2)
    try:
        with progress_bar(f"decode {source.folder.name}", len(everything)) as advance:
            for _ in threads.map(decode, everything):
                advance()
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
        writer.close()
