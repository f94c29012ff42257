"""A bound on the memory and the time that a test may take."""

import gc
import math
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager

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
