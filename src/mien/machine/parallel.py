"""Work on frames in parallel, each in one thread."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from mien import _native
from mien.machine.threads import thread_count

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The function's results for all items, in order. It uses up to MIEN_THREADS threads (by default, all cores)."""
    threads = min(thread_count(), len(items))
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if threads <= 1:
            return [function(item) for item in items]
        with ThreadPoolExecutor(threads, initializer=_prepare) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(before)


def stream_in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Yield the function's results for all items, in order. Only a few more items than threads are in memory.

    The default number of threads is `thread_count`.
    """
    threads = threads or thread_count()
    with ThreadPoolExecutor(threads, initializer=_prepare) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads + 2:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _prepare() -> None:
    torch.set_num_threads(1)
    _native.keep_loops_serial(True)  # The core's threads would only wait for a core.
    torch.set_grad_enabled(False)  # Each thread has its own mode.
