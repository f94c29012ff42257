"""Reading with limits: only ordinary files of limited size, and json with numbers of limited size."""

import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

_WHOLE_NUMBERS = range(-(1 << 63), 1 << 64)
_MOST_DIGITS = 20
"""Most characters of a whole number, with its sign. Python takes long to parse very many digits, and float() and numpy
refuse numbers that do not fit."""
_DEEPEST = 50
"""Most levels of nested lists and objects. Python has a limit of its own, but reaches it only later, when the content
is shown or compared."""


def parse_json(text: str) -> Any:
    """The content of a json text, in which all numbers fit into 64 bits.

    Raises:
        ValueError: the text is not json, or it holds NaN, infinity, a number that is too large, or lists that are
            nested too deep.
    """
    try:
        content = json.loads(text, parse_constant=_refuse_constant, parse_int=_whole_number, parse_float=_finite_number)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level = [content]
    for _ in range(_DEEPEST):
        level = [child for node in level for child in _children(node)]
        if not level:
            return content
    raise ValueError(_TOO_DEEP)


def read_bytes(path: Path, most: int) -> bytes:
    """The bytes of an ordinary file.

    Raises:
        ValueError: the file has more than `most` bytes, or is a pipe or device.
        OSError: the file is missing or cannot be read.
    """
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise ValueError(f"{size} bytes are too many")
        # Do not read to the end of the file, because the file may grow meanwhile.
        return file.read(size)


def open_ordinary(path: Path) -> IO[bytes]:
    """Open a file for reading, without waiting for a pipe.

    Raises:
        ValueError: it is a pipe or device.
        OSError: it is missing or cannot be read.
    """
    file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise ValueError("it is no ordinary file")
    return os.fdopen(file, "rb")


_TOO_DEEP = "lists or objects too deep in each other"


def _children(node: Any) -> Iterator[Any]:
    """The lists and objects directly inside a node."""
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return (child for child in inner if isinstance(child, (dict, list)))


def _refuse_constant(name: str) -> float:
    raise ValueError(f"holds the number {name}")


def _whole_number(digits: str) -> int:
    number = int(digits) if len(digits) <= _MOST_DIGITS else None
    if number is None or number not in _WHOLE_NUMBERS:
        raise ValueError(f"holds a number of {len(digits.lstrip('-'))} digits")
    return number


def _finite_number(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"holds the number {digits[:40]}")
    return number
