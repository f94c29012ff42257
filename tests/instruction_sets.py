"""Instruction sets and threads of the native core. The fixture `isa` skips sets that a machine lacks."""

import platform
from collections.abc import Callable
from typing import TypeVar

from mien import _native

T = TypeVar("T")
ISAS = ("avx512", "avx2", "sse4") if platform.machine() in ("x86_64", "AMD64") else ("baseline",)


def by_threads(compute: Callable[[], T], counts: tuple[int, ...] = (1, 3)) -> list[T]:
    before, results = _native.thread_count(), []
    try:
        for count in counts:
            _native.set_thread_count(count)
            results.append(compute())
    finally:
        _native.set_thread_count(before)
    return results
