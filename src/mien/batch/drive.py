"""Drives a batch: hands its rows to an engine, tries failed ones again, and keeps what comes back."""

import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

from mien.batch.engines import ENGINES, jobs_here, wait_for_earlier
from mien.batch.plan import Batch, Options, Row, State, Work
from mien.batch.progress import running_words
from mien.batch.row import attempt
from mien.batch.store import store_of
from mien.disk.files import write_atomically
from mien.disk.locks import BeingWrittenError, hold, holder_of
from mien.errors import UserError
from mien.machine.progress import Advance, progress_bar, say
from mien.machine.terminal import counted

OPTIONS_OF_ENGINES = {
    "local": ("store",),
    "slurm": ("gpus", "partition", "time"),
    "ray": ("gpus", "ray_address", "store"),
}
"""Engine -> those options of `mien batch` that not every engine has."""
MODULES_OF_ENGINES = {"slurm": "submitit", "ray": "ray"}
"""Engine -> the module that it needs."""
LOOK_SECONDS = 5.0
"""Time between two looks at what runs, for the progress."""


def shard_of(rows: Sequence[Row], text: str) -> list[Row]:
    """The rows of shard I of N, with I from 1: every N-th row."""
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise UserError(f"--shard {text}: give I/N with I from 1 to N, such as 3/20")
    return list(rows[int(first) - 1 :: int(last)])


def drive(batch: Batch, rows: Sequence[Row], options: Options, work: Work | None = None) -> None:
    """Run the rows until each is done, has failed too often, or is run by another command.

    `work` replaces the process of a row, for trials of the engines.
    """
    if options.on == "slurm":
        wait_for_earlier(batch)
    left = [row for row in rows if not batch.is_done(row)]
    say(f"{counted(len(rows), 'row')}: {len(rows) - len(left)} done before, {len(left)} to do on {options.on}")
    with (
        progress_bar("batch", len(rows), len(rows) - len(left)) as advance,
        _telling(batch, lambda: left, advance) as advance,
    ):
        for turn in range(options.retry + 1):
            with ExitStack() as claims:
                taken = _taken(batch, left, options, claims)
                todo = work or _work(batch, taken, options)
                for row, outcome in ENGINES[options.on](todo, taken, batch, options) if taken else ():
                    if _keep(batch, row, outcome, bool(options.store)):
                        advance(1, row.name)
                    elif turn == options.retry:
                        advance(1, f"{row.name} failed")
            left = [row for row in left if not batch.is_done(row)]
            if not left:
                break
    batch.remove_leftovers(rows)


@contextmanager
def _telling(batch: Batch, left: Callable[[], Sequence[Row]], advance: Advance) -> Iterator[Advance]:
    """Show now and then what runs, also before a row has ended. Yields `advance` for the ends of rows."""
    ended, one_at_a_time = threading.Event(), threading.Lock()

    def move(amount: int = 1, status: str = "") -> None:
        with one_at_a_time:
            advance(amount, status)

    def look() -> None:
        while not ended.wait(LOOK_SECONDS):
            with suppress(UserError, OSError):  # a file is being written, or damaged; the row's end tells of it
                move(0, running_words(batch, left()))

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    try:
        yield move
    finally:
        ended.set()
        looking.join()


def _taken(batch: Batch, rows: Sequence[Row], options: Options, claims: ExitStack) -> list[Row]:
    """The rows that no other command runs. With a store, this process claims them, since nodes see no locks."""
    taken = []
    for row in rows:
        file = batch.state_file(row.name)
        if options.store:
            with suppress(BeingWrittenError):
                claims.enter_context(hold(file))
                taken.append(row)
        elif holder_of(file) is None:
            taken.append(row)
    if len(taken) < len(rows):
        say(f"{counted(len(rows) - len(taken), 'row')} left to another command that runs them now")
    return taken


def _work(batch: Batch, rows: Sequence[Row], options: Options) -> Work:
    threads = options.threads or None
    if options.on == "local" and threads is None:
        from mien.machine.threads import thread_count

        threads = max(1, thread_count() // jobs_here(rows, options))
    place = (attempt_in_store, options.store) if options.store else (attempt, batch.root.resolve())
    return partial(*place, options.words_of_program(), threads)


def attempt_in_store(
    store: str, program: Sequence[str], threads: int | None, row: Row
) -> tuple[State | None, dict[str, bytes]]:
    """Run a row in a temporary folder of this machine, with its workspace copied in from a store and out to it.

    The store is the URL of the folder of all workspaces, such as s3://bucket/people. Returns the row's state, and its
    thumbnails and log: path in the batch's folder -> content.
    """
    fs, base = store_of(store)
    place = f"{base.rstrip('/')}/{row.name}"
    with tempfile.TemporaryDirectory(prefix="mien-batch-") as scratch:
        batch = Batch(Path(scratch))
        workspace = batch.workspace(row.name)
        if fs.exists(place):
            workspace.parent.mkdir(parents=True)
            fs.get(place, str(workspace), recursive=True)
        state = attempt(batch.root, program, threads, row)
        if workspace.is_dir():
            fs.makedirs(place, exist_ok=True)
            fs.put(f"{workspace}/", f"{place}/", recursive=True)
            ours = {path.relative_to(workspace).as_posix() for path in workspace.rglob("*")}
            for gone in fs.find(place):
                if gone.removeprefix(f"{place}/") not in ours:
                    fs.rm_file(gone)
        kept = [*batch.root.glob("thumbs/*"), *batch.root.glob("logs/*")]
        return state, {path.relative_to(batch.root).as_posix(): path.read_bytes() for path in kept}


def _keep(batch: Batch, row: Row, outcome: Any, in_store: bool) -> bool:
    """Keep what a row sent back, and return whether the row is done."""
    failed = isinstance(outcome, Exception)
    if failed:
        error = " ".join(str(outcome).split())[:500]
        state = State(row.name, "failed", row.fingerprint, batch.tries(row) + 1, error=error)
    else:
        state, files = outcome if in_store else (outcome, {})
        for name, content in files.items():
            place = batch.place(*name.split("/"))
            write_atomically(place, lambda aside, content=content: aside.write_bytes(content))
    if state is None:
        return False
    if failed or in_store:
        with suppress(BeingWrittenError), nullcontext() if in_store else hold(batch.state_file(row.name)):
            if in_store or not batch.is_done(row):
                batch.write_state(state)
    if state.status == "failed":
        say(f"{row.name} failed: {state.error}")
    return state.status == "done"
