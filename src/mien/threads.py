"""How many threads to use: the one place that reads MIEN_THREADS in Python (`native/pool.cpp` reads it for itself)."""

import os

from mien.errors import UserError

VARIABLE = "MIEN_THREADS"
MOST_THREADS = 1024
"""More than any machine that mien runs on has cores; each thread takes memory."""


def asked_threads() -> int | None:
    """What MIEN_THREADS asks for; None where it is not set.

    Raises:
        UserError: it is no number from 1 to `MOST_THREADS`.
    """
    text = os.environ.get(VARIABLE, "").strip()
    if not text:
        return None
    # The length is looked at first: Python refuses to read thousands of digits.
    number = int(text) if text.isascii() and text.isdigit() and len(text) <= len(str(MOST_THREADS)) else 0
    if not 1 <= number <= MOST_THREADS:
        shown = text if len(text) <= 40 else f"{text[:40]}..."
        raise UserError(f"{VARIABLE}={shown}: give a number from 1 to {MOST_THREADS}, or unset it for all cores")
    return number


def thread_count() -> int:
    """What MIEN_THREADS asks for, or else the number of cores.

    Raises:
        UserError: MIEN_THREADS is no number from 1 to `MOST_THREADS`.
    """
    return asked_threads() or os.cpu_count() or 1
