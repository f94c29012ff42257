"""A bound on the memory and the time that a test may take."""

import gc
import math
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mien.errors import UserError

MIB = 1 << 20


@contextmanager
def allocating_at_most(limit: int, seconds: float = math.inf) -> Iterator[None]:
    """Fail if Python and numpy allocate this many bytes or more at once, or if the block takes this many seconds."""
    gc.collect()
    began = time.monotonic()
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak / MIB:.0f} MiB"
    assert time.monotonic() - began < seconds


def refused(read: Callable[[Path], Any], path: Path, words: str, most: int = 64 * MIB) -> str:
    """Expect that a file is refused in one line that begins with its name, in a minute and without much memory."""
    with allocating_at_most(most, 60), pytest.raises(UserError, match=words) as error:
        read(path)
    message = str(error.value)
    assert message.startswith((f"{path}: ", f"{path}, "))
    assert "\n" not in message
    assert len(message) < 700
    return message
