"""Frames side by side: one thread each."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The function's results in order, by up to MIEN_THREADS threads (all cores) that share no work between them."""
    threads = min(int(os.environ.get("MIEN_THREADS", 0)) or os.cpu_count() or 1, len(items))
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if threads <= 1:
            return [function(item) for item in items]
        with ThreadPoolExecutor(threads, initializer=_prepare) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(before)


def _prepare() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)  # the mode is a thread's own
