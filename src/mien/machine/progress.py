"""Progress bars with an ETA for long work. If the output is no terminal, they print a line now and then."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mien.machine.terminal import printable, tell

Item = TypeVar("Item")


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Let the command line handle a closed pipe, as in all other output. Rich would end the process."""
        raise BrokenPipeError


console = _Console(stderr=True, highlight=False, markup=False, emoji=False)
"""The console for people, on standard error, so that standard output stays for results."""

_PLAIN_INTERVAL_SECONDS = 10.0
_beside = threading.local()
"""Its `advance` is called instead of a bar's in threads whose work stands beside that which a person waits for."""
_stage: list[str] = []
"""The name of the stage of the command that runs, if it has said so."""


@contextmanager
def stages(*names: str) -> Iterator[Callable[[str], None]]:
    """Give a function that says which stage of a command begins."""

    def begin(name: str) -> None:
        _stage[:] = [name]
        tell(f"stage {names.index(name) + 1} of {len(names)} ({name})")

    try:
        yield begin
    finally:
        _stage.clear()


def current_stage() -> str | None:
    """The name of the stage that the command is in; None if it has not said so."""
    return _stage[0] if _stage else None


@runtime_checkable  # for beartype, which checks annotations during tests
class Advance(Protocol):
    """A function that moves a progress bar on."""

    def __call__(self, amount: int = 1, status: str = "") -> None:
        """Advance by `amount` and show `status` behind the bar."""
        ...


def show_no_bars(advance: Advance) -> None:
    """Call `advance` instead of showing bars of the calling thread's work, as another thread has one."""
    _beside.advance = advance


def progress_bar(title: str, total: int, completed: int = 0) -> AbstractContextManager[Advance]:
    """A bar from `completed` to `total`. If the output is no terminal, it prints a line every ten seconds instead."""
    advance: Advance | None = getattr(_beside, "advance", None)
    if advance is not None:
        return nullcontext(advance)
    return (_bar if sys.stderr.isatty() else _plain_progress)(printable(title), total, completed)


@contextmanager
def _bar(title: str, total: int, completed: int) -> Iterator[Advance]:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}", markup=False),
    )
    with Progress(*columns, console=console, refresh_per_second=5) as bars:
        task = bars.add_task(title, total=total, completed=completed, status="")

        def advance(amount: int = 1, status: str = "") -> None:
            bars.update(task, advance=amount)
            if status:
                bars.update(task, status=printable(status))

        yield advance


@contextmanager
def _plain_progress(title: str, total: int, completed: int) -> Iterator[Advance]:
    start = last = first = time.monotonic()
    done = at_first = completed
    latest, told, calls = "", "", 0

    def report() -> None:
        nonlocal told
        elapsed, since_first = time.monotonic() - start, time.monotonic() - first
        # The first item takes longer, because it also loads and warms up what the others use.
        rate = (done - at_first) / since_first if calls >= 3 and since_first > 0 else 0.0
        eta = f", ETA {(total - done) / rate:.0f} s" if rate > 0 and done < total else ""
        if told != f"{done} {latest}":
            tell(f"{title}: {done}/{total} in {elapsed:.0f} s{eta}" + (f"; {latest}" if latest else ""))
        told = f"{done} {latest}"

    def advance(amount: int = 1, status: str = "") -> None:
        nonlocal done, last, latest, calls, first, at_first
        done, latest, calls = done + amount, status or latest, calls + 1
        if calls == 1:
            first, at_first = time.monotonic(), done
        if time.monotonic() - last >= _PLAIN_INTERVAL_SECONDS:
            last = time.monotonic()
            report()

    yield advance
    report()


def track_progress(items: Iterable[Item], title: str, total: int) -> Iterator[Item]:
    """Iterate over items with a progress bar."""
    with progress_bar(title, total) as advance:
        for item in items:
            yield item
            advance()


def say(message: str) -> None:
    """Print one line for people on standard error, with control characters made harmless (`mien.machine.terminal`)."""
    console.print(printable(message), soft_wrap=True)
