"""The number of threads. Only this module reads MIEN_THREADS in Python; `native/pool.cpp` reads it separately."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

from mien.errors import UserError

VARIABLE = "MIEN_THREADS"
MAX_THREADS = 1024
"""Largest number of threads. No machine that mien runs on has more cores, and each thread takes memory."""


def asked_threads() -> int | None:
    """The number of threads that MIEN_THREADS asks for, or None if it is not set."""
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
    """The number of threads that MIEN_THREADS asks for, or else the number of cores."""
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


def use_one_torch_thread() -> None:
    """Keep torch on one thread from now on, and leave the cores to native code: their two pools stall each other.

    If torch is not imported yet, it is limited when it is: commands that do not need it do not wait for its import.
    """
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    elif not any(isinstance(finder, _OneTorchThread) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OneTorchThread())


class _OneTorchThread(MetaPathFinder):
    """Limits torch to one thread when it is imported."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "torch":
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_limit(module: ModuleType) -> None:
            load(module)
            module.set_num_threads(1)
            sys.meta_path.remove(self)

        spec.loader.exec_module = load_and_limit
        return spec
