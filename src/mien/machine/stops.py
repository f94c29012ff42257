"""Orderly stops: SIGTERM and SIGHUP end a command as Ctrl-C does. Work that must not be half done puts them off."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mien.machine.system import HANGUPS, repeat_signal

EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143
EXIT_HUNG_UP = 129
"""Exit codes by convention: 128 and the number of the signal."""


class Terminated(SystemExit):
    """The process must end. Nothing catches it by mistake, as nothing catches a KeyboardInterrupt."""

    def __init__(self, code: int = EXIT_TERMINATED) -> None:
        super().__init__(code)


class HungUp(Terminated):
    """SIGHUP has come: the terminal was closed, or the connection to another machine was lost."""

    def __init__(self) -> None:
        super().__init__(EXIT_HUNG_UP)


_KINDS: dict[int, type[BaseException]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    **dict.fromkeys(HANGUPS, HungUp),
}
DEAF_SECONDS = 10.0
"""Time after a stop in which signals are ignored. Later ones count, since a library may have swallowed the first."""


class Put:
    """A stop that is put off: the work asks for it between two of its steps."""

    def __init__(self) -> None:
        self._number: int | None = None

    def ask(self, number: int, frame: object = None) -> None:
        """Note a signal; the first one counts."""
        self._number = self._number or number

    def asked(self) -> bool:
        """Whether the process was asked to stop."""
        return self._number is not None

    def follow(self) -> None:
        """Stop now if that was asked for: raise a KeyboardInterrupt, or `Terminated`."""
        if self._number is not None:
            raise _KINDS[self._number]


@contextmanager
def orderly_stops() -> Iterator[None]:
    """Let SIGTERM, SIGHUP and Ctrl-C raise `Terminated`, `HungUp` and KeyboardInterrupt: unfinished files are removed.

    Signals soon after the first are ignored, since they would interrupt the removal and the wait for threads in native
    code. If the exception is raised where Python can only report it (in a callback of a library), the stop is repeated.
    If a library turns it into an error of its own (while it is imported, for example), that error becomes the stop.
    """
    hook = sys.unraisablehook
    asked: list[tuple[int, float]] = []

    def stop(number: int, frame: object) -> None:
        now = time.monotonic()
        if not asked or now - asked[-1][1] > DEAF_SECONDS:
            asked.append((number, now))
            raise _KINDS[number]

    def repeat(dropped: "sys.UnraisableHookArgs") -> None:
        number = next((number for number, kind in _KINDS.items() if dropped.exc_type is kind), None)
        if number is None:
            hook(dropped)
            return
        asked.clear()
        again = threading.Timer(0.05, repeat_signal, [threading.get_ident(), number])
        again.daemon = True
        again.start()

    with _handled_by(stop) as is_handled:
        if is_handled:
            sys.unraisablehook = repeat
        try:
            yield
        except Exception as error:
            if asked:
                raise _KINDS[asked[-1][0]] from error
            raise
        finally:
            if is_handled:
                sys.unraisablehook = hook


@contextmanager
def stops_put_off() -> Iterator[Put]:
    """Put Ctrl-C, SIGTERM and SIGHUP off, so that none comes in the middle of a step. They take effect at the end."""
    put = Put()
    with _handled_by(put.ask):
        yield put
    put.follow()


@contextmanager
def _handled_by(handle: Callable[[int, object], None]) -> Iterator[bool]:
    """Give the signals that stop this process another handler. Yields False in a thread, where that is not possible.

    A shell lets what it starts in the background ignore Ctrl-C. nohup lets a command ignore a closed terminal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield False
        return
    handlers = {number: signal.getsignal(number) or signal.SIG_DFL for number in _KINDS}
    heard = {n: before for n, before in handlers.items() if n == signal.SIGTERM or before is not signal.SIG_IGN}
    for number in heard:
        signal.signal(number, handle)
    try:
        yield True
    finally:
        for number, before in heard.items():
            signal.signal(number, before)
