"""Bounds on what is read: ordinary files of limited size, json with numbers of limited size, pictures of limited size.

Everything here is plain Python, because options and paths are checked before any heavy library is imported.
"""

import errno
import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

MAX_SIDE = 8192
"""Largest width or height of a picture in pixels, of those that are read and of those that are rendered."""
_WHOLE_NUMBERS = range(-(1 << 63), 1 << 64)
_MAX_DIGITS = 20
"""Most characters of a whole number, with its sign. Python takes long to parse very many digits, and float() and numpy
refuse numbers that do not fit."""
_MAX_DEPTH = 50
"""Most levels of nested lists and objects. Python has a limit of its own, but reaches it only later, when the content
is shown or compared."""
_MAX_SHOWN = 40
"""Most characters of a name or number that a message shows."""


class NotOrdinaryError(ValueError):
    """A path is not an ordinary file, but a folder, a pipe, a device or a socket, or a link that is not followed."""


def parse_json(text: str, *, unique_names: bool = False, any_size: bool = False, constants: bool = False) -> Any:
    """The content of a json text. By default, all numbers in it are finite and fit into 64 bits.

    Args:
        text: the text.
        unique_names: whether an object that holds a name twice is refused, for texts that people write.
        any_size: whether numbers of any size are allowed, because the caller checks them and can name their place.
        constants: whether NaN and infinity are allowed, for the same reason.

    Raises:
        ValueError: the text is not json, or it holds a number or a name that is refused, or lists that are nested too
            deep.
    """
    hooks: dict[str, Any] = {} if any_size else {"parse_int": _whole_number, "parse_float": _finite_number}
    if not constants:
        hooks["parse_constant"] = _refuse_constant
    if unique_names:
        hooks["object_pairs_hook"] = _object_of_unique_names
    try:
        content = json.loads(text, **hooks)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level = [content]
    for _ in range(_MAX_DEPTH):
        level = [child for node in level for child in _children(node)]
        if not level:
            return content
    raise ValueError(_TOO_DEEP)


def read_bytes(path: Path, most: int) -> bytes:
    """The bytes of an ordinary file, which may be reached through a link.

    Raises:
        ValueError: the file has more than `most` bytes, or is not ordinary.
        OSError: the file is missing or cannot be read.
    """
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"it has {size:,} bytes, and at most {most:,} are read")
        # Do not read to the end of the file, because the file may grow meanwhile.
        return file.read(size)


def open_ordinary(path: Path) -> IO[bytes]:
    """Open an ordinary file for reading. The path may be a link, since it is the user who names it.

    Raises:
        NotOrdinaryError: it is a folder, a pipe, a device or a socket.
        OSError: it is missing or cannot be read.
    """
    return os.fdopen(open_handle(path, os.O_RDONLY, follow_link=True), "rb")


def open_handle(path: Path, flags: int, *, follow_link: bool) -> int:
    """The descriptor of an ordinary file. Opening never waits, not even for a process that writes into a pipe.

    Args:
        path: the file. With `O_CREAT` among the flags, it is created if it is missing.
        flags: flags of open(2).
        follow_link: whether the path itself may be a link.

    Raises:
        NotOrdinaryError: it is a folder, a pipe, a device or a socket, or a link that is not followed.
        OSError: it is missing or cannot be opened.
    """
    try:
        handle = os.open(path, flags | os.O_NONBLOCK | (0 if follow_link else os.O_NOFOLLOW), 0o644)
    except OSError as error:
        if error.errno in _NOT_ORDINARY or (error.errno == errno.ELOOP and not follow_link):
            raise NotOrdinaryError("it is not an ordinary file") from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise NotOrdinaryError("it is not an ordinary file")
    return handle


_NOT_ORDINARY = frozenset({errno.EISDIR, errno.ENXIO})
"""Errors of open(2) for folders that are opened to be written, and for sockets and pipes that nobody reads."""
_TOO_DEEP = "its lists or objects are nested too deep"


def _children(node: Any) -> Iterator[Any]:
    """The lists and objects directly inside a node."""
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return (child for child in inner if isinstance(child, (dict, list)))


def _refuse_constant(name: str) -> float:
    raise ValueError(f"it holds the number {name}")


def _object_of_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"it holds {twice[:_MAX_SHOWN]!r} twice")
    return content


def _whole_number(digits: str) -> int:
    number = int(digits) if len(digits) <= _MAX_DIGITS else None
    if number is None or number not in _WHOLE_NUMBERS:
        raise ValueError(f"it holds a number of {len(digits.lstrip('-'))} digits")
    return number


def _finite_number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"it holds the number {digits[:_MAX_SHOWN]}")
    return number
