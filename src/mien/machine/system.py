"""What Linux, macOS and Windows do differently: flags of open files, locks, processes, signals and memory.

No other module of mien asks for something that one of these systems lacks; `tests/test_terminal.py` checks that.
docs/platforms.md lists what was run on which system.
"""

import os
import signal
import sys
import time

IS_WINDOWS = sys.platform == "win32"

BINARY: int = getattr(os, "O_BINARY", 0)
"""Flag of open(2): bytes stay as they are. Only Windows would change ends of lines."""
NO_WAIT: int = getattr(os, "O_NONBLOCK", 0)
"""Flag of open(2): opening a pipe never waits for its other end. Windows has no pipes among its files."""
NO_LINK: int = getattr(os, "O_NOFOLLOW", 0)
"""Flag of open(2): a link is refused. Windows lacks it, so that `mien.disk.reading.open_handle` compares what it
opened."""

HANGUPS: tuple[int, ...] = (signal.SIGBREAK,) if sys.platform == "win32" else (signal.SIGHUP,)
"""Signals that come when the terminal is closed."""
SIGNATURE_AT = 1 if IS_WINDOWS else 0
"""Offset of the text in a lock file. A lock of Windows is of the first byte, which then nobody else can read."""

PARENT_VARIABLE = "MIEN_VIEWER_OF"
"""Environment variable of a viewer with the process whose end also ends it."""


def is_locked(handle: int) -> bool:
    """Whether another open file has the lock of this one. Nothing is created. OSError: the file system has no locks."""
    if sys.platform == "win32":
        # Windows has no shared lock of this kind here, so two that look at the same time meet: look again.
        from filelock import lock_descriptor, unlock_descriptor

        for _ in range(5):
            if lock_descriptor(handle, blocking=False):
                unlock_descriptor(handle)
                return False
            time.sleep(0.01)
        return True
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False


def may_live(pid: int) -> bool:
    """False if this machine has no process of this number. True if that cannot be found out."""
    if sys.platform == "win32":
        # Here, os.kill(pid, 0) would send Ctrl-C to a process.
        import ctypes

        kernel, query, wrong_number, running = ctypes.windll.kernel32, 0x1000, 87, 259
        process = kernel.OpenProcess(query, False, pid)
        if not process:
            return kernel.GetLastError() != wrong_number
        code = ctypes.c_ulong()
        known = kernel.GetExitCodeProcess(process, ctypes.byref(code))
        kernel.CloseHandle(process)
        return not known or code.value == running
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # the process belongs to another user
        return True
    return True


def end_this_process() -> None:
    """Send SIGTERM to this process, from any of its threads: the main thread stops in an orderly way."""
    if sys.platform == "win32":
        # os.kill would end the process at once, without removing unfinished files.
        import _thread

        _thread.interrupt_main(signal.SIGTERM)
    else:
        os.kill(os.getpid(), signal.SIGTERM)


def repeat_signal(thread: int, number: int) -> None:
    """Send a signal to a thread of this process. On Windows, it is always the main thread that gets it."""
    if sys.platform == "win32":
        import _thread

        _thread.interrupt_main(number)
    else:
        signal.pthread_kill(thread, number)


def peak_memory_mb() -> float:
    """The most memory that this process has taken so far, in MiB; 0 on Windows, where it is not asked for."""
    if sys.platform == "win32":
        return 0.0
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (1 << 20) if sys.platform == "darwin" else most / 1024


def lower_priority(pid: int, steps: int) -> None:
    """Let a process wait for others, by that many steps of nice(1). On Windows, nothing changes."""
    if sys.platform != "win32":
        os.setpriority(os.PRIO_PROCESS, pid, steps)


def load_average() -> float:
    """Number of processes that were running or waiting in the last minute, on average; 0 on Windows, which has none."""
    return os.getloadavg()[0] if sys.platform != "win32" else 0.0


def read_at(handle: int, most: int, offset: int) -> bytes:
    """Read at most that many bytes of an open file at an offset. Its position does not matter, and may change."""
    if sys.platform == "win32":
        os.lseek(handle, offset, os.SEEK_SET)
        return os.read(handle, most)
    return os.pread(handle, most, offset)


def write_at(handle: int, data: "bytes | memoryview", offset: int) -> int:
    """Write bytes into an open file at an offset, and return their number. Its position may change."""
    if sys.platform == "win32":
        os.lseek(handle, offset, os.SEEK_SET)
        return os.write(handle, data)
    return os.pwrite(handle, data, offset)
