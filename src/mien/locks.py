"""Two commands on one workspace: who writes holds a lock, who reads never waits.

`hold` takes the lock of a place (a folder or a file, there or not): the hidden file `.NAME.lock` beside it, under
flock(2). The system releases it when the process ends, however it ends, so a lock is never left over. A place that
another process holds is told at once (`BeingWrittenError`), with what that process wrote into the file about itself.

The file goes with the lock. That is safe, because it is removed only under its lock, and because whoever gets a lock
looks whether the file still has its name, and else starts again. After a kill it stays, unlocked, for the next one.

The file may come from a stranger with the workspace: no link is followed, and what it says is not trusted
(`mien.lock_holder`).

Which command holds which locks is in docs/conventions.md, "Two commands at once". Readers use `read_beside_writers`.
"""

import errno
import fcntl
import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from mien.errors import CannotWriteError, UserError
from mien.files import cannot_write
from mien.lock_holder import read_holder, sign
from mien.progress import say

Result = TypeVar("Result")

WAIT, AGAIN = "wait until it is done, or end it", "try again when it is done"
"""Remedies, for who writes and for who reads."""
_LONGEST_NAME = 240
"""Bytes; file systems allow 255."""
_NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS})
_REMOVED = frozenset({errno.ENOENT, errno.ESTALE})
"""By who released it (ESTALE: on another machine), with folders that stayed empty."""
_PATIENCE_SECONDS, _STEP_SECONDS = 0.5, 0.01
"""How long a lock is asked for again whose holder does not say its name: it may be a reader that looks at it for a
moment, a process that was killed and is about to end, or one that signs in a moment."""
_NAMELESS = "which has not left its name"
_PAUSES_SECONDS = (0.0, 0.02, 0.05, 0.1)
"""Before a reader reads again what a writer has changed under its hands."""

_ours: dict[int, tuple[int, int]] = {}
"""Open lock files of this process -> their device and number."""
_once: set[str] = set()
"""What was done or said in this process and is not to be repeated."""


class BeingWrittenError(UserError):
    """Another process writes this place now."""


@contextmanager
def hold(*places: Path, remedy: str = WAIT) -> Iterator[None]:
    """Be the only one that writes these places (folders or files, there or not) while the context lasts.

    Folders above them are made, and go again if they stay empty. In a file system without locks it warns, once, and
    goes on.

    Args:
        places: taken in their order by name, so that of two processes that want the same ones the first gets all.
        remedy: what to tell if another process has one.

    Raises:
        BeingWrittenError: another process, or another thread of this one, holds one of them.
        CannotWriteError: nothing can be written beside a place.
    """
    with ExitStack() as stack:
        for place in sorted(set(places)):
            stack.enter_context(_hold_one(place, remedy))
        yield


def check_free(place: Path, remedy: str = WAIT) -> None:
    """Tell before any work, by a BeingWrittenError, that another process writes a place."""
    holder = holder_of(place)
    if holder is not None:
        raise _being_written(place, holder, remedy)


def holder_of(place: Path) -> str | None:
    """Which other process writes a place, in words; None where nobody does, or only this process."""
    try:
        handle = _open(lock_file(place), os.O_RDONLY)
    except (OSError, UserError):
        return None
    try:
        if _identity(os.fstat(handle)) in _ours.values():
            return None
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _wait_for_name(handle)
    except OSError:
        return None
    finally:
        os.close(handle)
    return None


def read_beside_writers(read: Callable[[], Result], folders: Sequence[Path], places: Sequence[Path]) -> Result:
    """What `read` returns. Where it fails because a writer replaced files while it read, it is called again.

    Args:
        read: raises a UserError where what it finds is missing or damaged.
        folders: whose files it reads.
        places: whose locks the writers of these folders hold.

    Raises:
        BeingWrittenError: it fails, and another process is at work there.
        UserError: it fails otherwise.
    """
    for pause in (*_PAUSES_SECONDS, None):
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
    """The hidden file beside a place whose lock is the place's."""
    place = Path(os.path.abspath(place))  # noqa: PTH100 (`resolve` would follow a link in the place of a folder)
    name = f".{place.name}.lock"
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = f".{hashlib.sha256(os.fsencode(place.name)).hexdigest()[:32]}.lock"
    return place.with_name(name)


@contextmanager
def _hold_one(place: Path, remedy: str) -> Iterator[None]:
    file, process = lock_file(place), os.getpid()
    try:
        missing = [folder for folder in file.parents if not folder.exists()]
        handle = _acquire(place, file, remedy)
    except OSError as error:
        raise cannot_write(place, error) from None
    try:
        yield
    finally:
        if os.getpid() == process:  # a child made by fork has closed its copy, and the lock is its parent's
            _release(file, handle)
            for folder in missing:
                with suppress(OSError):
                    folder.rmdir()


def _acquire(place: Path, file: Path, remedy: str) -> int | None:
    """An open and locked file; None where the file system has no locks."""
    _let_children_forget()
    patience = time.monotonic() + _PATIENCE_SECONDS
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        locked, holder, handle = True, None, None
        try:
            handle = _open_own(file)
            locked = _try_lock(handle)
            if locked and _is_named(handle, file):
                sign(handle, file)
                _ours[handle] = _identity(os.fstat(handle))
                return handle
            holder = None if locked else read_holder(handle)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                _warn_of_no_locks(file)
                return None
            if error.errno not in _REMOVED:
                raise
        finally:
            if handle is not None and handle not in _ours:
                os.close(handle)
        patient = time.monotonic() < patience
        if holder is not None or not (locked or patient):
            raise _being_written(place, holder or _NAMELESS, remedy)
        if not patient:
            raise OSError(errno.EAGAIN, "its lock file is removed again and again", str(file))
        time.sleep(_STEP_SECONDS)


def _try_lock(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _wait_for_name(handle: int) -> str:
    for _ in range(round(_PATIENCE_SECONDS / 2 / _STEP_SECONDS)):
        holder = read_holder(handle)
        if holder is not None:
            return holder
        time.sleep(_STEP_SECONDS)
    return _NAMELESS


def _release(file: Path, handle: int | None) -> None:
    if handle is None:
        return
    # Under its lock: who waits for this very file finds that it has lost its name.
    with suppress(OSError):
        if _is_named(handle, file):
            file.unlink()
    _ours.pop(handle, None)
    os.close(handle)


def _open_own(file: Path) -> int:
    """The lock file, made unless it is there."""
    try:
        return _open(file, os.O_RDWR | os.O_CREAT)
    except PermissionError:
        if not file.is_file():
            raise
        return _open(file, os.O_RDONLY)  # another user's: it can be locked all the same


def _open(file: Path, flags: int) -> int:
    """Open a lock file: no link, no pipe that would be waited for, nothing that has another name besides.

    Raises:
        UserError: it is none.
        OSError: it cannot be opened.
    """
    remedy = "it takes the place of a lock file; remove it"
    try:
        handle = os.open(file, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise UserError(f"{file}: is no ordinary file; {remedy}") from None
        raise
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(handle)
        raise UserError(f"{file}: is no ordinary file, or has a second name; {remedy}")
    return handle


def _is_named(handle: int, file: Path) -> bool:
    """Whether the open file is still the one of that name."""
    opened = os.fstat(handle)
    try:
        named = file.lstat()
    except FileNotFoundError:
        return False
    return opened.st_nlink > 0 and _identity(opened) == _identity(named)


def _identity(status: os.stat_result) -> tuple[int, int]:
    return status.st_dev, status.st_ino


def _being_written(place: Path, holder: str, remedy: str) -> BeingWrittenError:
    return BeingWrittenError(f"{place}: is being written by another command ({holder}); {remedy}")


def _state(folder: Path) -> object:
    """Changes whenever a folder or one of the files right in it is replaced."""
    try:
        own = folder.stat()
        files = [(entry.name, entry.stat(follow_symlinks=False)) for entry in os.scandir(folder) if not entry.is_dir()]
    except OSError:
        return None
    return _identity(own), sorted((name, *_identity(each), each.st_mtime_ns, each.st_size) for name, each in files)


def _warn_of_no_locks(file: Path) -> None:
    if "warned" not in _once:
        _once.add("warned")
        say(f"warning: {file.parent}: its file system has no locks; run one command at a time on what lies there")


def _let_children_forget() -> None:
    """A child made by fork shares its parent's locks and must not keep them when the parent has died."""
    if "fork" not in _once:
        _once.add("fork")
        os.register_at_fork(after_in_child=_forget)


def _forget() -> None:
    for handle in _ours:
        with suppress(OSError):
            os.close(handle)
    _ours.clear()
