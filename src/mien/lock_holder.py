"""The process that holds a lock signs the lock file, and later processes read that. `mien.locks` has the locks."""

import json
import os
import shlex
import socket
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mien.errors import UserError

_BEGINNING = b'{"format": "mien.lock"'
"""Every lock file of mien begins with this."""
_MOST_BYTES = 4096
_SHOWN = {"host": 60, "since": 30, "command": 200}
"""Number of characters that are shown of each entry about a holder."""


def sign(handle: int, file: Path) -> None:
    """Write into an open lock file that this process holds it, with pid, host, time and command line.

    Raises:
        UserError: the file is not a lock file of mien. It stays as it is.
    """
    found = os.pread(handle, len(_BEGINNING), 0)
    if found != _BEGINNING[: len(found)]:
        raise UserError(f"{file}: is no lock file of mien; it takes the place of one; move it away")
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]) if sys.argv else "python"
    about = {
        "format": "mien.lock",
        "pid": os.getpid(),
        "host": socket.gethostname()[: _SHOWN["host"]],
        "since": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "command": command[: _SHOWN["command"] + 1],
    }
    text = json.dumps(about).encode()
    with suppress(OSError):  # a full disk, or another user's file: the lock holds even without a signature
        os.ftruncate(handle, 0)
        os.pwrite(handle, text, 0)


def read_holder(handle: int) -> str | None:
    """The holder of an open lock file, described in one line. The content of the file is not trusted.

    The result is None if the file names no process, or one that has ended: the holder has not signed yet.
    """
    about = _parsed(os.pread(handle, _MOST_BYTES, 0))
    if about is None or not _may_live(about):
        return None
    words = {name: _shown(about.get(name), longest) for name, longest in _SHOWN.items()}
    return f"process {about['pid']} on {words['host']}, since {words['since']}: {words['command']}"


def _parsed(text: bytes) -> dict[str, Any] | None:
    try:
        about = json.loads(text)
    except (ValueError, RecursionError):
        return None
    pid = about.get("pid") if isinstance(about, dict) else None
    return about if isinstance(pid, int) and 0 < pid < 1 << 31 else None


def _may_live(about: dict[str, Any]) -> bool:
    """False if the holder is a process of this machine that has ended."""
    if about.get("host") != socket.gethostname()[: _SHOWN["host"]]:
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
