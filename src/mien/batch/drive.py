"""Drives a batch: hands its rows to an engine, tries failed ones again, and keeps what comes back."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mien.batch.engines import EngineOptions, Work, engine_named
from mien.batch.plan import Batch, Row, State
from mien.batch.progress import running_words
from mien.batch.row import PROGRAM, attempt
from mien.batch.store import Returned, attempt_in_store
from mien.disk.files import write_atomically
from mien.disk.locks import BeingWrittenError, hold, holder_of
from mien.errors import UserError
from mien.machine.progress import Advance, progress_bar, say
from mien.machine.terminal import counted


def shard_of(rows: Sequence[Row], text: str) -> list[Row]:
    """The rows of shard I of N, with I from 1: every N-th row."""
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise UserError(f"--shard {text}: give I/N with I from 1 to N, such as 3/20")
    return list(rows[int(first) - 1 :: int(last)])


@dataclass(frozen=True)
class Driver:
    """How the rows of a batch are run."""

    batch: Batch
    engine: str
    options: EngineOptions
    retry: int = 2
    """How often a failed row is tried again."""
    store: str = ""
    """URL of the store of workspaces. Empty if all nodes share the batch's folder."""
    program: tuple[str, ...] = ()
    """The command of a row's process. Empty means this Python with `-m mien.commands.batch_row`."""
    work: Work | None = None
    """A function that runs a row in place of `attempt`, for trials of the engines."""
    look_seconds: float = 5.0
    """Time between two looks at what runs, for the progress."""

    def run(self, rows: Sequence[Row]) -> None:
        """Run the rows until each is done, has failed too often, or is run by another command."""
        engine = engine_named(self.engine)
        engine.wait_for_earlier(self.options.root)
        left = [row for row in rows if not self.batch.is_done(row)]
        say(f"{counted(len(rows), 'row')}: {len(rows) - len(left)} done before, {len(left)} to do on {self.engine}")
        with (
            progress_bar("batch", len(rows), len(rows) - len(left)) as advance,
            self._telling(lambda: left, advance) as advance,
        ):
            for turn in range(self.retry + 1):
                with ExitStack() as claims:
                    taken = self._taken(left, claims)
                    for row, outcome in engine.run(self._work(taken), taken, self.options) if taken else ():
                        done = self._keep(row, outcome)
                        if done:
                            advance(1, row.name)
                        elif turn == self.retry:
                            advance(1, f"{row.name} failed")
                left = [row for row in left if not self.batch.is_done(row)]
                if not left:
                    break
        self.batch.remove_leftovers(rows)

    @contextmanager
    def _telling(self, left: Callable[[], Sequence[Row]], advance: Advance) -> Iterator[Advance]:
        """Show now and then what runs, also before a row has ended. Yields `advance` for the ends of rows."""
        ended, one_at_a_time = threading.Event(), threading.Lock()

        def move(amount: int = 1, status: str = "") -> None:
            with one_at_a_time:
                advance(amount, status)

        def look() -> None:
            while not ended.wait(self.look_seconds):
                with suppress(UserError, OSError):  # a file is being written, or damaged; the row's end tells of it
                    move(0, running_words(self.batch, left()))

        looking = threading.Thread(target=look, daemon=True)
        looking.start()
        try:
            yield move
        finally:
            ended.set()
            looking.join()

    def _taken(self, rows: Sequence[Row], claims: ExitStack) -> list[Row]:
        """The rows that no other command runs. With a store, this process claims them, since nodes see no locks."""
        taken = []
        for row in rows:
            file = self.batch.state_file(row.name)
            if not self.store:
                if holder_of(file) is None:
                    taken.append(row)
                continue
            try:
                claims.enter_context(hold(file))
                taken.append(row)
            except BeingWrittenError:
                continue
        if len(taken) < len(rows):
            say(f"{counted(len(rows) - len(taken), 'row')} left to another command that runs them now")
        return taken

    def _work(self, rows: Sequence[Row]) -> Work:
        if self.work is not None:
            return self.work
        threads = self.options.threads or None
        if self.engine == "local" and threads is None:
            from mien.batch.engines.local import jobs_here
            from mien.machine.threads import thread_count

            threads = max(1, thread_count() // jobs_here(rows, self.options))
        if self.store:
            return partial(_attempt_in_store, self.store, self.program or PROGRAM, threads)
        return partial(_attempt, str(self.options.root.resolve()), self.program or PROGRAM, threads)

    def _keep(self, row: Row, outcome: Any) -> bool:
        """Keep what a row sent back, and return whether the row is done."""
        state = outcome
        if isinstance(outcome, Returned):
            state = outcome.state
            for name, content in outcome.files.items():
                write_atomically(self.batch.place(*name.split("/")), partial(_write, content))
        if isinstance(outcome, Exception):
            before = self.batch.read_state(row.name)
            state = State(row.name, "failed", row.fingerprint, error=" ".join(str(outcome).split())[:500])
            state = replace(state, tries=before.tries + 1 if before is not None else 1)
        if self.store and state is not None:
            self.batch.write_state(state)
        elif isinstance(outcome, Exception) and state is not None:
            try:
                with hold(self.batch.state_file(row.name)):
                    if not self.batch.is_done(row):
                        self.batch.write_state(state)
            except BeingWrittenError:
                return False
        if state is not None and state.status == "failed":
            say(f"{row.name} failed: {state.error}")
        return state is not None and state.status == "done"


def _write(content: bytes, path: Any) -> None:
    path.write_bytes(content)


def _attempt(root: str, program: tuple[str, ...], threads: int | None, row: Row) -> State | None:
    from pathlib import Path

    return attempt(Path(root), row, program, threads)


def _attempt_in_store(store: str, program: tuple[str, ...], threads: int | None, row: Row) -> Returned:
    return attempt_in_store(store, row, program, threads)
