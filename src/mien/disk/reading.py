"""Bounds on what is read: ordinary files of limited size, json with numbers of limited size.

After these, and after format, version and checksum (`mien.disk.files`), a reader of mien's own files trusts what mien
wrote, inside `expect_whole`.

Everything here is plain Python, because options and paths are checked before any heavy library is imported.
"""

import errno
import json
import math
import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast

from mien.errors import UserError
from mien.machine.system import BINARY, NO_LINK, NO_WAIT

MAX_SIDE = 8192
"""Largest width or height of a picture in pixels, of those that are read and of those that are rendered."""
_MAX_SHOWN = 40
"""Most characters of a name or number that a message shows."""
_COSTS = {"[": 64, "{": 232, ",": 40}
"""Bytes that Python takes for a list, an object, and a further entry with its number or text, about."""
_ARCHIVE_END_SIZE, _MAX_COMMENT_BYTES = 22, 65535
_STUMBLES = (
    LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError, MemoryError, EOFError,
    struct.error,
)  # fmt: skip
"""What a reader that trusts a file raises if it is not as mien wrote it."""


class NotOrdinaryError(ValueError):
    """A path is not an ordinary file, but a folder, a pipe, a device or a socket, or a link that is not followed."""


@contextmanager
def expect_whole(path: Path, remedy: str) -> Iterator[None]:
    """Report whatever a reader stumbles over in the content of `path` as one sentence, with what the user can do."""
    try:
        yield
    except _STUMBLES as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UserError(f"{path}: incomplete or damaged ({reason}); {remedy}") from None


def parse_json(text: str, *, unique_names: bool = False, any_size: bool = False, constants: bool = False) -> Any:
    """The content of a json text; a ValueError says what is wrong with it.

    With `unique_names`, an object that holds a name twice is refused, for texts that people write. Callers that check
    numbers themselves, and can name their place, allow `any_size`, or the `constants` NaN and infinity.
    """
    if sum(cost * text.count(sign) for sign, cost in _COSTS.items()) > 1 << 30:  # empty lists take 20 times their text
        raise ValueError("it holds too many lists, objects or numbers")
    hooks: dict[str, Any] = {} if any_size else {"parse_int": _whole_number, "parse_float": _finite_number}
    if not constants:
        hooks["parse_constant"] = _refuse_constant
    if unique_names:
        hooks["object_pairs_hook"] = _object_of_unique_names
    try:
        content = json.loads(text, **hooks)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level: list[Any] = [[content]]
    for _ in range(51):  # Python's own limit is reached only later, when the content is shown or compared
        inner = [child for node in level for child in (node.values() if isinstance(node, dict) else node)]
        level = [child for child in inner if isinstance(child, (dict, list))]
        if not level:
            return content
    raise ValueError(_TOO_DEEP)


_TOO_DEEP = "its lists or objects are nested too deep"


def _refuse_constant(name: str) -> float:
    raise ValueError(f"it holds the number {name}")


def _object_of_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"it holds {twice[:_MAX_SHOWN]!r} twice")
    return content


def _whole_number(digits: str) -> int:
    # Python takes long to parse very many digits, and float() and numpy refuse numbers that do not fit.
    if len(digits) > 20 or not -(1 << 63) <= (number := int(digits)) < 1 << 64:
        raise ValueError(f"it holds a number of {len(digits.lstrip('-'))} digits")
    return number


def _finite_number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"it holds the number {digits[:_MAX_SHOWN]}")
    return number


def read_bytes(path: Path | str, most: int) -> bytes:
    """The bytes of an ordinary file, which may be reached through a link. A ValueError says that it has too many."""
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"it has {size:,} bytes, and at most {most:,} are read")
        return file.read(size)  # not to its end, because the file may grow meanwhile


def open_ordinary(path: Path | str) -> IO[bytes]:
    """Open an ordinary file for reading. The path may be a link, since it is the user who names it."""
    return os.fdopen(open_handle(path, os.O_RDONLY, follow_link=True), "rb")


def open_archive(file: IO[bytes]) -> zipfile.ZipFile:
    """Open a zip archive whose list of members is of moderate size. Its members are checked by `open_member`."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _MAX_COMMENT_BYTES - _ARCHIVE_END_SIZE))
    tail = file.read()
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) < place + _ARCHIVE_END_SIZE:
        raise ValueError("its end is missing: copy it again")
    directory = int.from_bytes(tail[place + 12 : place + 16], "little")
    # Each member takes about 50 bytes. The mark is that of archives of 4 GB, or with more than 65,534 members.
    if directory > 1 << 20 or tail[max(0, place - 20) : place].startswith(b"PK\x06\x07"):
        raise ValueError("it has far more members than such a file")
    return zipfile.ZipFile(file)


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> zipfile.ZipExtFile:
    """Open a member of an archive for reading, if it is neither encrypted nor compressed as Python may not know."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("is compressed in an unusual way")
    try:
        return cast(zipfile.ZipExtFile, archive.open(member))
    except (RuntimeError, NotImplementedError) as error:
        raise ValueError(f"cannot be unpacked ({str(error)[:_MAX_SHOWN]})") from None


def open_handle(path: Path | str, flags: int, *, follow_link: bool) -> int:
    """The descriptor of an ordinary file, opened with flags of open(2). `follow_link`: whether the path may be a link.

    Opening never waits, not even for a process that writes into a pipe.
    """
    try:
        handle = os.open(path, flags | NO_WAIT | BINARY | (0 if follow_link else NO_LINK), 0o666)
    except OSError as error:
        # EISDIR: a folder that is opened to be written; ENXIO: a socket, or a pipe that nobody reads.
        if error.errno in (errno.EISDIR, errno.ENXIO) or (error.errno == errno.ELOOP and not follow_link):
            raise NotOrdinaryError("it is not an ordinary file") from None
        raise
    linked = not follow_link and not NO_LINK and Path(path).is_symlink()
    if linked or not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise NotOrdinaryError("it is not an ordinary file")
    return handle
