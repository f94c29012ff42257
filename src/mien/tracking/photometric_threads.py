"""Frames side by side: one thread each."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from mien.threads import thread_count

Item = TypeVar("Item")
Result = TypeVar("Result")
_AHEAD = 2
"""Results that may wait beside those being made."""


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The function's results in order, by up to MIEN_THREADS threads (all cores) that share no work between them."""
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


def stream_in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """As `in_threads`, one result after another: only a few more than there are threads wait to be taken."""
    with ThreadPoolExecutor(thread_count(), initializer=_prepare) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > thread_count() + _AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _prepare() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)  # the mode is a thread's own
