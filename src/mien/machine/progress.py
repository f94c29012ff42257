"""Progress bars with an ETA for long work. If the output is no terminal, they print a line now and then."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mien.machine.terminal import printable, tell

_PRIOR_SECONDS = 3.0
"""Weight of the expected times against measured ones, as seconds of measured work."""
_TRUSTED_SHARE = 0.1
"""Share of a piece after which its own speed tells how long the rest of it takes."""
_PLAIN_INTERVAL_SECONDS, _WHOLE_INTERVAL_SECONDS = 10.0, 60.0
"""Time between two lines about a bar and about the whole command, if the output is no terminal."""


@dataclass(frozen=True)
class Piece:
    """A part of a stage that has a progress bar of its own."""

    stage: str
    title: str
    """Beginning of the title of its progress bar."""
    seconds: float
    """Expected time on a machine like that of docs/results.md, in seconds. Only the ratios matter in the end."""


class Overall:
    """How far a command is, and how long the rest will take. Mutable.

    Pieces come in their order. A piece whose bar never opens, because its result is current, takes no time. A bar that
    no piece belongs to changes nothing.
    """

    def __init__(self, pieces: Sequence[Piece], clock: Callable[[], float] = time.monotonic) -> None:
        self._pieces, self._clock = tuple(pieces), clock
        self._stages = list(dict.fromkeys(piece.stage for piece in pieces))
        self._at = -1
        self._began, self._first, self._share, self._own = 0.0, 0.0, 1.0, 0.0
        self._expected = self._measured = _PRIOR_SECONDS
        self._told, self._told_stage = 0.0, 0

    def begin(self, title: str, share: float) -> bool:
        """Note that a bar opens with this share done already; return whether it is a piece's."""
        # A bar that comes once more, for another part of a clip, is the same piece.
        own = [index for index, piece in enumerate(self._pieces) if title.startswith(piece.title)]
        later = [index for index in own if index > self._at]
        if not later and self._at not in own:
            return False
        found = later[0] if later else self._at
        # The expected time of a piece counts once, with its first part.
        self._own = self._pieces[found].seconds * (1.0 - share) if found != self._at else 0.0
        self._at, self._began, self._first, self._share = found, self._clock(), share, share
        return True

    def advance(self, share: float) -> None:
        """Note that this share of the current piece is done."""
        self._share = min(max(share, self._share), 1.0)

    def end(self) -> None:
        """Note that the current piece is done. Its time tells how long the later ones will take."""
        self._share = 1.0
        self._expected += self._own
        self._measured += self._clock() - self._began if self._first < 1.0 else 0.0

    def remaining(self) -> float:
        """The expected time to the end of the command, in seconds."""
        pace = self._measured / self._expected
        later = pace * sum(piece.seconds for piece in self._pieces[self._at + 1 :])
        spent, gained = self._clock() - self._began, self._share - self._first
        if self._share >= 1.0:
            return later
        if gained < _TRUSTED_SHARE:
            return later + max(pace * self._own - spent, 0.0)
        return later + spent / gained * (1.0 - self._share)

    def stage(self) -> int:
        """Number of the current stage, from 1; 0 before the first."""
        return self._stages.index(self._pieces[self._at].stage) + 1 if self._at >= 0 else 0

    def stage_name(self) -> str | None:
        """Name of the current stage; None before the first."""
        return self._pieces[self._at].stage if self._at >= 0 else None

    def words(self) -> str:
        """The stage and the remaining time, beside a progress bar."""
        return f"all: stage {self.stage()} of {len(self._stages)}, {_about(self.remaining())}"

    def tell_now_and_then(self) -> None:
        """Print a line at the begin of each stage, and later now and then."""
        now, stage = time.monotonic(), self.stage()
        if stage != self._told_stage or now - self._told >= _WHOLE_INTERVAL_SECONDS:
            self._told, self._told_stage = now, stage
            left = f"{_about(self.remaining())} left of the whole command"
            tell(f"stage {stage} of {len(self._stages)} ({self.stage_name() or 'start'}), {left}")


def _about(seconds: float) -> str:
    if seconds < 10:
        return "less than 10 s"
    if seconds < 90:
        return f"about {10 * round(seconds / 10)} s"
    if seconds < 90 * 60:
        return f"about {round(seconds / 60)} min"
    return f"about {seconds / 3600:.1f} h"


Item = TypeVar("Item")


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Let the command line handle a closed pipe, as in all other output. Rich would end the process."""
        raise BrokenPipeError


console = _Console(stderr=True, highlight=False, markup=False, emoji=False)
"""The console for people, on standard error, so that standard output stays for results."""

_whole: list[Overall] = []
"""The whole command that runs, if it has said what it will do."""


@contextmanager
def whole_command(overall: Overall) -> Iterator[None]:
    """Show the remaining time of the whole command beside the progress of its parts."""
    _whole.append(overall)
    try:
        yield
    finally:
        _whole.pop()


def current_stage() -> str | None:
    """The name of the stage that the whole command is in; None if no command has said what it will do."""
    return _whole[-1].stage_name() if _whole else None


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
    whole = _whole[-1] if _whole and _whole[-1].begin(title, completed / max(total, 1)) else None
    bar = _bar if sys.stderr.isatty() else _plain_progress
    done = completed
    with bar(title, total, completed, whole) as move:

        def advance(amount: int = 1, status: str = "") -> None:
            nonlocal done
            done += amount
            if whole is not None:
                whole.advance(done / max(total, 1))
            move(amount, status)

        yield advance
    if whole is not None:
        whole.end()


@contextmanager
def _bar(title: str, total: int, completed: int, whole: Overall | None) -> Iterator[Advance]:
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
                bars.update(task, status="; ".join(filter(None, (latest, whole.words()))))
            elif status:
                bars.update(task, status=latest)

        yield advance


@contextmanager
def _plain_progress(title: str, total: int, completed: int, whole: Overall | None) -> Iterator[Advance]:
    if whole is not None:
        whole.tell_now_and_then()
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
