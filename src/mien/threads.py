"""The number of threads. Only this module reads MIEN_THREADS in Python; `native/pool.cpp` reads it separately."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from mien.errors import UserError

VARIABLE = "MIEN_THREADS"
MAX_THREADS = 1024
"""Largest number of threads. No machine that mien runs on has more cores, and each thread takes memory."""


def asked_threads() -> int | None:
    """The number of threads that MIEN_THREADS asks for, or None if it is not set.

    Raises:
        UserError: it is not a number from 1 to `MAX_THREADS`.
    """
    text = os.environ.get(VARIABLE, "").strip()
    if not text:
        return None
    # The length is checked first, because Python refuses to parse thousands of digits.
    number = int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(MAX_THREADS)) else 0
    if not 1 <= number <= MAX_THREADS:
        shown = text if len(text) <= 40 else f"{text[:40]}..."
        raise UserError(f"{VARIABLE}={shown}: give a number from 1 to {MAX_THREADS}, or unset it for all cores")
    return number


def thread_count() -> int:
    """The number of threads that MIEN_THREADS asks for, or else the number of cores.

    Raises:
        UserError: MIEN_THREADS is not a number from 1 to `MAX_THREADS`.
    """
    return asked_threads() or os.cpu_count() or 1


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch on one thread. Its thread pool and another one, native or of Python, would wait for each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
