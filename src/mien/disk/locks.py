"""Two commands on one workspace: writers hold a lock, and readers never wait.

`hold` takes the lock of a place (a folder or a file, which may be missing). The lock is the hidden file `.NAME.lock`
beside the place, locked by the library filelock, with flock(2) or Windows' LockFileEx. The system releases it when the
process ends, however it ends, so no lock is ever left over. If another process holds a place, `hold` raises
`BeingWrittenError` at once and quotes what that process wrote about itself into the file.

The file is removed with the lock. That is safe, because it is removed only while it is locked, and because a process
that gets the lock of a removed file starts again. After a kill the file stays, unlocked, and the next process uses it.
The file may come from a stranger together with the workspace: no link is followed, and its content is not trusted.

Readers use `read_beside_writers`. They look at a lock by `mien.machine.system.is_locked`, because they must not create
the file, and because two of them that look at the same time must not take each other for writers. filelock has no such
look. docs/conventions.md, "Two commands at once", lists which command holds which locks.
"""

import errno
import hashlib
import json
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from mien.disk.files import cannot_write
from mien.disk.reading import open_handle, parse_json
from mien.errors import CannotWriteError, UserError
from mien.machine.progress import say
from mien.machine.system import IS_WINDOWS, SIGNATURE_AT, is_locked, may_live, read_at, write_at
from mien.machine.terminal import printable

Result = TypeVar("Result")

WAIT, AGAIN = "wait until it is done, or end it", "try again when it is done"
"""Remedies for writers and for readers."""
PATIENCE_SECONDS, _STEP_SECONDS = 0.5, 0.01
"""Seconds to try again for a lock without a readable holder, and between two tries.

The holder may be a reader that checks the lock for a
moment, a process that was killed and is about to end, or a process that is about to sign."""
_NAMELESS = "which has not left its name"

_BEGINNING = b'{"format": "mien.lock"'
"""First bytes of every lock file of mien."""

_ours: dict[tuple[int, int], int] = {}
"""Device and number of each lock file that is held -> the process that holds it. A child made by fork has a copy."""
said_once: set[str] = set()
"""Messages that are shown only once per process."""


class BeingWrittenError(UserError):
    """Another process is writing this place."""


@contextmanager
def hold(*places: Path, remedy: str = WAIT) -> Iterator[None]:
    """Be the only writer of these places (folders or files, which may be missing) while the context lasts.

    Missing parent folders are created, and removed again if they stay empty. If the file system has no locks, this
    warns once and continues. A BeingWrittenError with the advice `remedy` says that another process, or another thread
    of this one, holds a place.
    """
    with ExitStack() as stack:
        for place in sorted(set(places)):  # so that of two processes that want the same places the first gets all
            stack.enter_context(_hold_one(place, remedy))
        yield


def check_free(place: Path, remedy: str = WAIT) -> None:
    """Raise a BeingWrittenError before any work if another process is writing a place."""
    holder = holder_of(place)
    if holder is not None:
        raise _being_written(place, holder, remedy)


def holder_of(place: Path) -> str | None:
    """A description of the other process that is writing a place, or None if there is none."""
    return _holder(lock_file(place), ours=False)


def read_beside_writers(read: Callable[[], Result], folders: Sequence[Path], places: Sequence[Path]) -> Result:
    """Return the result of `read`. If it fails because a writer replaced files meanwhile, it is called again.

    It reads these folders, whose writers lock these places. If one of them holds a lock when it fails for the last
    time, a BeingWrittenError says so.
    """
    for pause in (0.0, 0.02, 0.05, 0.1, None):  # before it reads again what a writer changed in the meantime
        before = [_state(folder) for folder in folders]
        try:
            return read()
        except (BeingWrittenError, CannotWriteError):
            raise
        except (UserError, OSError, ValueError, LookupError):
            writer = next(((place, who) for place in places if (who := holder_of(place)) is not None), None)
            if writer is None and (pause is None or before == [_state(folder) for folder in folders]):
                raise
            if writer is not None and pause is None:
                raise _being_written(*writer, AGAIN) from None
            time.sleep(pause or 0.0)
    raise AssertionError("the last try returns or raises")


def lock_file(place: Path) -> Path:
    """The path of a place's lock file, a hidden file beside the place."""
    place = Path(os.path.abspath(place))  # noqa: PTH100 (`resolve` would follow a link in the place of a folder)
    name = f".{place.name}.lock"
    if len(os.fsencode(name)) > 240:  # file systems allow 255 bytes
        name = f".{hashlib.sha256(os.fsencode(place.name)).hexdigest()[:32]}.lock"
    return place.with_name(name)


@contextmanager
def _hold_one(place: Path, remedy: str) -> Iterator[None]:
    file, process = lock_file(place), os.getpid()
    try:
        missing = [folder for folder in file.parents if not folder.exists()]
        unlock = _acquire(place, file, remedy)
    except OSError as error:
        raise cannot_write(place, error) from None
    try:
        yield
    finally:
        if os.getpid() == process:  # in a child made by fork, filelock has closed the copy; the lock is its parent's
            unlock()
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()


def _acquire(place: Path, file: Path, remedy: str) -> Callable[[], None]:
    """Lock the file, and return what removes and unlocks it. That does nothing if the file system has no locks."""
    patience = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return _lock(file)
        except Timeout:
            holder = _holder(file)
            if holder not in (None, _NAMELESS) or time.monotonic() >= patience:
                raise _being_written(place, holder or _NAMELESS, remedy) from None
        except OSError as error:
            if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS):
                if "no locks" not in said_once:
                    said_once.add("no locks")
                    say(f"warning: {file.parent}: its file system has no locks; run only one command at a time there")
                return lambda: None
            # The process that released the lock may have removed the file and its empty folders (ESTALE: elsewhere).
            if error.errno not in (errno.ENOENT, errno.ESTALE) or time.monotonic() >= patience:
                raise
        time.sleep(_STEP_SECONDS)


def _lock(file: Path) -> Callable[[], None]:
    """Lock and sign the file, which is created if it is missing. Returns what removes and unlocks it.

    A Timeout says that another process or thread has locked it, an OSError also that it was removed meanwhile.
    """
    with suppress(FileNotFoundError):
        _check_plain(file, file.lstat())
    with ExitStack() as held:
        begin = partial(_begin, file, held)
        lock = FileLock(file, blocking=False, thread_local=False, fallback_to_soft=False, on_acquired=begin)
        held.callback(lock.release)
        lock.acquire()
        return held.pop_all().close


def _begin(file: Path, held: ExitStack, handle: int) -> None:
    """Check and sign the open and locked file. It is removed at the end of `held`."""
    opened = os.fstat(handle)
    _check_plain(file, opened)
    # Over NFS, a removed file that is open still has a name, so filelock does not notice that it was removed.
    # On Windows, a file that is open cannot be removed.
    if not IS_WINDOWS and _identity(opened) != _identity(file.lstat()):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(file))
    _sign(handle, file)
    _ours[_identity(opened)] = os.getpid()
    held.callback(_remove, file, _identity(opened))


def _remove(file: Path, identity: tuple[int, int]) -> None:
    """Remove the file while it is locked: a process that waits for it then finds that it has lost its name."""
    _ours.pop(identity, None)
    with suppress(OSError):
        if _identity(file.lstat()) == identity:
            file.unlink()


def _check_plain(file: Path, status: os.stat_result) -> None:
    """Refuse links, folders, pipes and files with a second name."""
    if not stat.S_ISREG(status.st_mode):
        raise UserError(f"{file}: is not an ordinary file, but has the name of a lock file; remove it")
    if status.st_nlink > 1:
        raise UserError(f"{file}: has a second name, which no lock file has; remove it")


def _holder(file: Path, *, ours: bool = True) -> str | None:
    """A description of the process that has locked the file, or None. `ours`: whether this process counts."""
    try:
        handle = open_handle(file, os.O_RDONLY, follow_link=False)
    except (OSError, ValueError):
        return None
    try:
        if not ours and _ours.get(_identity(os.fstat(handle))) == os.getpid():
            return None
        if not is_locked(handle):
            return None
        for _ in range(round(PATIENCE_SECONDS / 2 / _STEP_SECONDS)):
            if (holder := _read_holder(handle)) is not None:
                return holder
            time.sleep(_STEP_SECONDS)
        return _NAMELESS
    except OSError:
        return None
    finally:
        os.close(handle)


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _being_written(place: Path, holder: str, remedy: str) -> BeingWrittenError:
    return BeingWrittenError(f"{place}: is being written by another command ({holder}); {remedy}")


def _state(folder: Path) -> object:
    """A state that changes if the folder or a file directly in it is replaced."""
    try:
        own = folder.stat()
        files = [(entry.name, entry.stat(follow_symlinks=False)) for entry in os.scandir(folder) if not entry.is_dir()]
    except OSError:
        return None
    return _identity(own), sorted((name, *_identity(each), each.st_mtime_ns, each.st_size) for name, each in files)


def _sign(handle: int, file: Path) -> None:
    """Write into an open lock file that this process holds it, with pid, host, time and command line."""
    found = read_at(handle, len(_BEGINNING), SIGNATURE_AT)
    if found != _BEGINNING[: len(found)]:
        raise UserError(f"{file}: has the name of a lock file, but mien did not write it; move it away")
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]) if sys.argv else "python"
    about = {
        "format": "mien.lock",
        "pid": os.getpid(),
        "host": socket.gethostname()[:60],
        "since": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "command": command[:200],
    }
    text = json.dumps(about).encode()
    with suppress(OSError):  # a full disk: the lock holds even without a signature
        os.ftruncate(handle, 0)
        write_at(handle, text, SIGNATURE_AT)


def _read_holder(handle: int) -> str | None:
    """The holder of an open lock file, described in one line of limited length. The content of the file is not trusted.

    The result is None if the file names no process, or one that has ended: the holder has not signed yet.
    """
    try:
        about = parse_json(read_at(handle, 4096, SIGNATURE_AT).decode())
        pid, host, since, command = (about[name] for name in ("pid", "host", "since", "command"))
        if not 0 < pid < 1 << 31 or (host == socket.gethostname()[:60] and not may_live(pid)):
            return None
    except (ValueError, LookupError, TypeError):
        return None
    return printable(f"process {pid} on {str(host)[:60]}, since {str(since)[:30]}: {str(command)[:200]}")
