"""Check shapes and types of calls (jaxtyping with beartype), but not where a test computes for seconds.

jaxtyping's pytest plugin decorates every function of mien when its module is imported. Here, a function gets its checks
at its first checked call, since most functions have none in a process, and a test that is marked `unchecked` has none.
"""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType
from typing import Any

import jaxtyping
from jaxtyping import config

_jaxtyped: Any = jaxtyping.jaxtyped


def check_types(wanted: bool) -> None:
    config.update("jaxtyping_disable", not wanted)


@contextmanager
def unchecked() -> Iterator[None]:
    before = config.jaxtyping_disable
    check_types(False)
    try:
        yield
    finally:
        check_types(not before)


def _lazily_jaxtyped(*arguments: Any, **options: Any) -> Any:
    """Do what `jaxtyping.jaxtyped` does, but for functions at their first checked call."""
    if arguments:
        return _jaxtyped(*arguments, **options)

    def decorate(function: Any) -> Any:
        if not isinstance(function, FunctionType):
            return _jaxtyped(**options)(function)
        checked: Callable[..., Any] | None = None

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal checked
            if config.jaxtyping_disable:
                return function(*args, **kwargs)
            if checked is None:
                checked = _jaxtyped(**options)(function)
            assert checked is not None
            return checked(*args, **kwargs)

        return call

    return decorate


# Modules that are imported from now on find this decorator, so tests/conftest.py imports this file before mien.
jaxtyping.jaxtyped = _lazily_jaxtyped
