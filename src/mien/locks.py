"""Two commands on one workspace: writers hold a lock, and readers never wait.

`hold` takes the lock of a place (a folder or a file, which may be missing). The lock is the hidden file `.NAME.lock`
beside the place, locked with flock(2). The system releases it when the process ends, however it ends, so no lock is
ever left over. If another process holds a place, `hold` raises `BeingWrittenError` at once and quotes what that process
wrote about itself into the file.

The file is removed with the lock. That is safe, because it is removed only while it is locked, and because each process
that gets a lock checks that the file still has its name, and starts again if not. After a kill the file stays,
unlocked, and the next process uses it.

The file may come from a stranger together with the workspace: no link is followed, and its content is not trusted.

docs/conventions.md, "Two commands at once", lists which command holds which locks. Readers use `read_beside_writers`.
"""

import errno
import fcntl
import hashlib
import json
import os
import shlex
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from mien.bounded import NotOrdinaryError, open_handle, parse_json
from mien.errors import CannotWriteError, UserError
from mien.files import cannot_write
from mien.progress import say

Result = TypeVar("Result")

WAIT, AGAIN = "wait until it is done, or end it", "try again when it is done"
"""Remedies for writers and for readers."""
_MAX_NAME_BYTES = 240
"""Longest name of a lock file, in bytes. File systems allow 255."""
_NO_LOCKS = frozenset({errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS})
_REMOVED = frozenset({errno.ENOENT, errno.ESTALE})
"""Errors if the process that released the lock has removed the file and the folders that stayed empty (ESTALE: on
another machine)."""
_PATIENCE_SECONDS, _STEP_SECONDS = 0.5, 0.01
"""Seconds to try again for a lock without a readable holder, and between two tries.

The holder may be a reader that checks the lock for a
moment, a process that was killed and is about to end, or a process that is about to sign."""
_NAMELESS = "which has not left its name"
_PAUSES_SECONDS = (0.0, 0.02, 0.05, 0.1)
"""Pauses before a reader reads again files that a writer changed in the meantime."""

_BEGINNING = b'{"format": "mien.lock"'
"""First bytes of every lock file of mien."""
_MAX_SIGNATURE_BYTES = 4096
_MAX_SHOWN = {"host": 60, "since": 30, "command": 200}
"""Most characters that are shown of each entry about a holder."""

_ours: dict[int, tuple[int, int]] = {}
"""Open lock files of this process -> their device and number."""
_once: set[str] = set()
"""Actions and messages that happen only once per process."""


class BeingWrittenError(UserError):
    """Another process is writing this place."""


@contextmanager
def hold(*places: Path, remedy: str = WAIT) -> Iterator[None]:
    """Be the only writer of these places (folders or files, which may be missing) while the context lasts.

    Missing parent folders are created, and removed again if they stay empty. If the file system has no locks, this
    warns once and continues.

    Args:
        places: locked in the order of their names, so that of two processes that want the same places the first gets
            all.
        remedy: advice for the message if another process holds a place.

    Raises:
        BeingWrittenError: another process, or another thread of this one, holds a place.
        CannotWriteError: no lock file can be written beside a place.
    """
    with ExitStack() as stack:
        for place in sorted(set(places)):
            stack.enter_context(_hold_one(place, remedy))
        yield


def check_free(place: Path, remedy: str = WAIT) -> None:
    """Raise a BeingWrittenError before any work if another process is writing a place."""
    holder = holder_of(place)
    if holder is not None:
        raise _being_written(place, holder, remedy)


def holder_of(place: Path) -> str | None:
    """A description of the other process that is writing a place, or None if there is none."""
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
    """Return the result of `read`. If it fails because a writer replaced files meanwhile, it is called again.

    Args:
        read: raises a UserError if files are missing or damaged.
        folders: the folders that it reads.
        places: the places that writers of these folders lock.

    Raises:
        BeingWrittenError: it fails while another process is writing there.
        UserError: it fails for another reason.
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
    """The path of a place's lock file, a hidden file beside the place."""
    place = Path(os.path.abspath(place))  # noqa: PTH100 (`resolve` would follow a link in the place of a folder)
    name = f".{place.name}.lock"
    if len(os.fsencode(name)) > _MAX_NAME_BYTES:
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
    """The descriptor of the open and locked file, or None if the file system has no locks."""
    _let_children_forget()
    patience = time.monotonic() + _PATIENCE_SECONDS
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        locked, holder, handle = True, None, None
        try:
            handle = _open_own(file)
            locked = _try_lock(handle)
            if locked and _is_named(handle, file):
                _sign(handle, file)
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
    # Remove it while it is locked: a process that waits for this file then finds that it has lost its name.
    with suppress(OSError):
        if _is_named(handle, file):
            file.unlink()
    _ours.pop(handle, None)
    os.close(handle)


def _open_own(file: Path) -> int:
    """Open the lock file, and create it if it is missing."""
    try:
        return _open(file, os.O_RDWR | os.O_CREAT)
    except PermissionError:
        if not file.is_file():
            raise
        return _open(file, os.O_RDONLY)  # another user's file, which can still be locked


def _open(file: Path, flags: int) -> int:
    """Open a lock file. Links, pipes and files with a second name are refused.

    Raises:
        UserError: the path is not a plain file with a single name.
        OSError: it cannot be opened.
    """
    try:
        handle = open_handle(file, flags, follow_link=False)
    except NotOrdinaryError:
        raise UserError(f"{file}: is not an ordinary file, but has the name of a lock file; remove it") from None
    if os.fstat(handle).st_nlink > 1:
        os.close(handle)
        raise UserError(f"{file}: has a second name, which no lock file has; remove it")
    return handle


def _is_named(handle: int, file: Path) -> bool:
    """Whether the open file is still the file of that name."""
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
    """A state that changes if the folder or a file directly in it is replaced."""
    try:
        own = folder.stat()
        files = [(entry.name, entry.stat(follow_symlinks=False)) for entry in os.scandir(folder) if not entry.is_dir()]
    except OSError:
        return None
    return _identity(own), sorted((name, *_identity(each), each.st_mtime_ns, each.st_size) for name, each in files)


def _warn_of_no_locks(file: Path) -> None:
    if "warned" not in _once:
        _once.add("warned")
        say(f"warning: {file.parent}: its file system has no locks; run only one command at a time there")


def _let_children_forget() -> None:
    """Close the locks in children made by fork, which would otherwise keep them after their parent has died."""
    if "fork" not in _once:
        _once.add("fork")
        os.register_at_fork(after_in_child=_forget)


def _forget() -> None:
    for handle in _ours:
        with suppress(OSError):
            os.close(handle)
    _ours.clear()


def _sign(handle: int, file: Path) -> None:
    """Write into an open lock file that this process holds it, with pid, host, time and command line.

    Raises:
        UserError: the file is not a lock file of mien. It stays as it is.
    """
    found = os.pread(handle, len(_BEGINNING), 0)
    if found != _BEGINNING[: len(found)]:
        raise UserError(f"{file}: has the name of a lock file, but mien did not write it; move it away")
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]) if sys.argv else "python"
    about = {
        "format": "mien.lock",
        "pid": os.getpid(),
        "host": socket.gethostname()[: _MAX_SHOWN["host"]],
        "since": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "command": command[: _MAX_SHOWN["command"] + 1],
    }
    text = json.dumps(about).encode()
    with suppress(OSError):  # a full disk, or another user's file: the lock holds even without a signature
        os.ftruncate(handle, 0)
        os.pwrite(handle, text, 0)


def read_holder(handle: int) -> str | None:
    """The holder of an open lock file, described in one line. The content of the file is not trusted.

    The result is None if the file names no process, or one that has ended: the holder has not signed yet.
    """
    about = _parsed(os.pread(handle, _MAX_SIGNATURE_BYTES, 0))
    if about is None or not _may_live(about):
        return None
    words = {name: _shown(about.get(name), longest) for name, longest in _MAX_SHOWN.items()}
    return f"process {about['pid']} on {words['host']}, since {words['since']}: {words['command']}"


def _parsed(text: bytes) -> dict[str, Any] | None:
    try:
        about = parse_json(text.decode())
    except ValueError:
        return None
    pid = about.get("pid") if isinstance(about, dict) else None
    return about if isinstance(pid, int) and 0 < pid < 1 << 31 else None


def _may_live(about: dict[str, Any]) -> bool:
    """False if the holder is a process of this machine that has ended."""
    if about.get("host") != socket.gethostname()[: _MAX_SHOWN["host"]]:
        return True
    try:
        os.kill(about["pid"], 0)
    except ProcessLookupError:
        return False
    except OSError:  # the process belongs to another user
        return True
    return True


def _shown(text: object, longest: int) -> str:
    """Untrusted text for a terminal: one line, without control characters, of limited length."""
    plain = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text)[: longest + 1])
    return plain if len(plain) <= longest else plain[:longest] + "..."
