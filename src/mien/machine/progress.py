"""Progress bars with an ETA for long work. If the output is no terminal, they print a line now and then."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mien.machine.terminal import printable, tell
from mien.overall import Overall

Item = TypeVar("Item")


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Let the command line handle a closed pipe, as in all other output. Rich would end the process."""
        raise BrokenPipeError


console = _Console(stderr=True, highlight=False, markup=False, emoji=False)
"""The console for people, on standard error, so that standard output stays for results."""

_PLAIN_INTERVAL_SECONDS = 10.0
_CALLS_BEFORE_ETA = 3
_WHOLE_INTERVAL_SECONDS = 60.0
"""Time between two lines about the whole command, if the output is no terminal."""


class _Whole:
    """What progress bars tell about the whole command, of which each bar is a part."""

    def __init__(self, overall: Overall) -> None:
        self.overall = overall
        self._told, self._stage = 0.0, 0

    def tell_now_and_then(self) -> None:
        """Print a line at the begin of each stage, and later now and then."""
        now, stage = time.monotonic(), self.overall.stage()
        if stage != self._stage or now - self._told >= _WHOLE_INTERVAL_SECONDS:
            self._told, self._stage = now, stage
            tell(self.overall.words())


_whole: list[_Whole] = []
"""The whole command that runs, if it has said what it will do."""


@contextmanager
def whole_command(overall: Overall) -> Iterator[None]:
    """Show the remaining time of the whole command beside the progress of its parts."""
    _whole.append(_Whole(overall))
    try:
        yield
    finally:
        _whole.pop()


def current_stage() -> str | None:
    """The name of the stage that the whole command is in; None if no command has said what it will do."""
    return _whole[-1].overall.stage_name() if _whole else None


@runtime_checkable  # for beartype, which checks annotations during tests
class Advance(Protocol):
    """A function that moves a progress bar on."""

    def __call__(self, amount: int = 1, status: str = "") -> None:
        """Advance by `amount` and show `status` behind the bar."""
        ...


@contextmanager
def progress_bar(title: str, total: int, completed: int = 0) -> Iterator[Advance]:
    """A bar from `completed` to `total`. If the output is no terminal, it prints a line every ten seconds instead."""
    title = printable(title)
    whole = _whole[-1] if _whole and _whole[-1].overall.begin(title, completed / max(total, 1)) else None
    bar = _bar if sys.stderr.isatty() else _plain_progress
    done = completed
    with bar(title, total, completed, whole) as move:

        def advance(amount: int = 1, status: str = "") -> None:
            nonlocal done
            done += amount
            if whole is not None:
                whole.overall.advance(done / max(total, 1))
            move(amount, status)

        yield advance
    if whole is not None:
        whole.overall.end()


@contextmanager
def _bar(title: str, total: int, completed: int, whole: _Whole | None) -> Iterator[Advance]:
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
        latest = ""

        def advance(amount: int = 1, status: str = "") -> None:
            nonlocal latest
            latest = printable(status) or latest
            bars.update(task, advance=amount)
            if whole is not None:
                bars.update(task, status="; ".join(filter(None, (latest, whole.overall.short_words()))))
            elif status:
                bars.update(task, status=latest)

        yield advance


@contextmanager
def _plain_progress(title: str, total: int, completed: int, whole: _Whole | None) -> Iterator[Advance]:
    if whole is not None:
        whole.tell_now_and_then()
    start = last = first = time.monotonic()
    done = at_first = completed
    latest, told, calls = "", "", 0

    def report() -> None:
        nonlocal told
        elapsed, since_first = time.monotonic() - start, time.monotonic() - first
        # The first item takes longer, because it also loads and warms up what the others use.
        rate = (done - at_first) / since_first if calls >= _CALLS_BEFORE_ETA and since_first > 0 else 0.0
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
            if whole is not None:
                whole.tell_now_and_then()

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
