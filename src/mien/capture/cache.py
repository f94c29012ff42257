"""The decoded cache of a capture. It is rebuilt when the capture or one of its PNGs has changed."""

import hashlib
import itertools
import os
import tempfile
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from mien.capture.frame_files import CACHE, FRAMES, MATTES, REMEDY, CacheWriter, FrameLayout, read_png
from mien.disk.files import read_json, write_json
from mien.disk.inside import drop_if_shared, remove_tree
from mien.disk.locks import BeingWrittenError, hold
from mien.errors import CannotWriteError, UserError
from mien.machine.progress import progress_bar
from mien.media.picture_files import map_pictures

_FORMAT, _VERSION = "mien.capture_cache", 1
_THREADS = 2
_MAX_QUEUED = 16
_SCRATCH_PREFIX, _ASIDE_PREFIX = "mien-capture-", ".making-"


def stamp_cache(layout: FrameLayout, capture_hash: str) -> None:
    """Record that the cache is complete and matches the PNGs."""
    write_json(
        layout.folder / CACHE / "stamp.json",
        _FORMAT,
        _VERSION,
        {"capture_hash": capture_hash, "fingerprint": _fingerprint(layout)},
    )


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
    _read_first(layout, digests)
    try:
        drop_if_shared(layout.folder / CACHE)
        with hold(layout.raw(FRAMES)):
            if not _is_valid(layout, capture_hash):
                _replace_cache(layout, digests)
                stamp_cache(layout, capture_hash)
        return layout
    except (OSError, BeingWrittenError):
        scratch = replace(layout, folder=Path(tempfile.mkdtemp(prefix=_SCRATCH_PREFIX)))
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


def _read_first(layout: FrameLayout, digests: dict[str, np.ndarray]) -> None:
    """Check the first frame and matte, so that a wrong size in `capture.json` fails before disk space is allocated."""
    for kind in (FRAMES, MATTES):
        read_png(layout.png(kind, 0, 0), layout.shape(kind)[2:], int(digests[kind][0, 0]))


def _decode_all(source: FrameLayout, target: FrameLayout, digests: dict[str, np.ndarray]) -> None:
    writer = CacheWriter(target)

    def decode(kind: str, timestep: int, camera: int) -> None:
        path = source.png(kind, timestep, camera)
        picture = read_png(path, source.shape(kind)[2:], int(digests[kind][timestep, camera]))
        writer.write(kind, timestep, camera, np.ascontiguousarray(picture))

    cameras = range(len(source.camera_ids))
    everything = itertools.product((FRAMES, MATTES), range(source.timesteps), cameras)
    total = 2 * source.timesteps * len(cameras)
    pending: deque[Future[None]] = deque()
    threads = ThreadPoolExecutor(_THREADS)
    try:
        with progress_bar(f"decode {source.folder.name}", total) as advance:
            for kind, timestep, camera in everything:
                pending.append(threads.submit(decode, kind, timestep, camera))
                if len(pending) >= _MAX_QUEUED:
                    pending.popleft().result()
                    advance()
            while pending:
                pending.popleft().result()
                advance()
    finally:
        threads.shutdown(wait=True, cancel_futures=True)
        writer.close()
