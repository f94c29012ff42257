"""`mien batch`: a table of captures in, an avatar for each row out."""

import importlib.util
import json
import shlex
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from mien.batch.drive import MODULES_OF_ENGINES, OPTIONS_OF_ENGINES, drive, shard_of
from mien.batch.plan import Batch, Options, Row
from mien.batch.progress import batch_progress, progress_text
from mien.batch.store import store_of
from mien.disk.config import Range
from mien.disk.files import check_writable
from mien.errors import UserError
from mien.machine.progress import say
from mien.machine.terminal import counted, show

if TYPE_CHECKING:
    from mien.batch.paper import Paper

_COUNT = Range(0, 100_000)


@dataclass(frozen=True)
class Run:
    """Make an avatar from each row of a table, here, on a Slurm cluster, or on a Ray cluster (docs/scale.md).

    The same command continues: it runs all rows that are not done. Options of `mien create` after the table, such as
    --preset draft, count for all rows; a cell of the table goes first.

    mien batch status DIR: how far each row is, what failed and why, and when it will be done.

    mien batch PEOPLE --paper examples/papers/FILE.toml --out DIR: a paper's table, with our figures beside its own.
    PEOPLE is a folder with a video, or a dataset's folder, for each subject. Each method of the file is trained on each
    subject with the paper's settings and scored, which takes days. --subjects 1 --steps 300 --preset draft is a trial.
    """

    takes_more: ClassVar[bool] = True
    table: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TABLE")]
    """A csv or json of captures, or a folder of videos. With --paper also a folder with a dataset for each subject."""
    out: Path
    """Folder of the batch, new or existing."""
    paper: Path | None = None
    """A file that describes a paper's table: its methods, their settings, how they are scored, and the paper's figures
    (examples/papers/NAME.toml). DIR/table.md has the result, with our means over subjects. Options of `mien import`,
    `capture`, `track`, `train` and `evaluate` replace those of the file; --lpips-weights FILE is needed for LPIPS."""
    subjects: Annotated[int, _COUNT] = 0
    """Use only the first so many subjects. 0 means all."""
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    shard: str = ""
    """Run only rows I, I+N, ..., given as I/N with I from 1 to N. For Kubernetes, SkyPilot and GNU parallel."""
    for_all: Annotated[tuple[str, ...], tyro.conf.Fixed, tyro.conf.Suppress] = ()
    """Options of `mien create`."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        self.options.check()
        engine, store = self.options.on, self.options.store
        for name in ("gpus", "partition", "time", "ray_address", "store"):
            if getattr(self.options, name) and name not in OPTIONS_OF_ENGINES[engine]:
                raise UserError(f"--{name.replace('_', '-')}: changes nothing for --on {engine}; leave it out")
        module = MODULES_OF_ENGINES.get(engine)
        if module is not None and importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)
        check_writable(self.out, folder=True)
        if self.shard:
            shard_of([], self.shard)
        if store and "://" not in store:
            raise UserError(f"--store {store}: give a URL, such as s3://bucket/people or file:///mnt/people")
        if store:
            store_of(store)
        if not self.table.exists():
            raise UserError(f"{self.table}: no such file or folder; give a table of captures, or a folder of videos")

    def run(self) -> None:
        """Run the rows, and write the results."""
        from mien.batch.paper import write_table
        from mien.batch.results import write_results, write_wall

        batch, (rows, paper), known = Batch(self.out), self._rows(), []
        labels = dict.fromkeys(label for row in rows for label in row.labels)
        if labels:
            say(f"labels, which come back in the results: {', '.join(labels)}")
        with suppress(UserError):  # there is no earlier table, or it is damaged and will be replaced
            known = [row.name for row in batch.read_plan()]
        dropped = [name for name in known if name not in {row.name for row in rows}]
        if dropped:
            shown = ", ".join(dropped[:5]) + (", ..." if len(dropped) > 5 else "")
            say(f"{counted(len(dropped), 'row')} of an earlier table will not be listed any more ({shown}); files stay")
        batch.write_plan(rows)
        chosen = shard_of(rows, self.shard) if self.shard else rows
        for some in filter(None, ([row for row in chosen if row.first], [row for row in chosen if not row.first])):
            drive(batch, some, self.options)
        table = write_table(batch, results := write_results(batch), paper)
        if paper is None:
            write_wall(batch, results)
        else:
            write_wall(batch, results, table, (paper.title, paper.source))
        progress = batch_progress(batch)
        for line in progress_text(progress).splitlines():
            say(line)
        say(f"Look at {self.out / 'index.html'}; the figures are in {self.out / 'results.csv'} and table.md")
        failed, status = progress["counts"].get("failed", 0), f"mien batch status {shlex.quote(str(self.out))}"
        if failed:
            raise UserError(f"{failed} of {counted(len(rows), 'row')} failed; see `{status}`")

    def _rows(self) -> "tuple[list[Row], Paper | None]":
        """The rows, and the table of the paper."""
        from mien.batch.paper import read_paper
        from mien.commands.batch_paper import subject_rows, with_runs
        from mien.commands.batch_table import columns_of, read_entries, read_table

        if self.paper is None:
            return read_table(self.table, self.for_all)[: self.subjects or None], None
        usual = columns_of(self.for_all)
        paper = with_runs(read_paper(self.paper), self.paper, usual)
        entries = read_entries(self.table, usual, paper=True)
        paper = replace(paper, subjects=max(paper.subjects, len(entries)))
        rows = subject_rows(entries[: self.subjects or None], paper)
        if any(row.first for row in rows) and (self.shard or self.options.store):
            raise UserError(f"--paper {self.paper}: subjects drive each other; leave --shard and --store out")
        return rows, paper


@dataclass(frozen=True)
class Status:
    """Show how far each row of a batch is, what failed and why, and when all will be done."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the batch."""
    watch: bool = False
    """Show it again every five seconds, until all rows have ended."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print json on standard output, for programs."""

    def run(self) -> None:
        """Show the status."""
        while True:
            found = batch_progress(Batch(self.folder))
            show(json.dumps(found, indent=1) if self.as_json else progress_text(found))
            if not self.watch or not set(found["counts"]) & {"waiting", "running", "interrupted"}:
                return
            time.sleep(5)


TASKS = {"": Run, "status": Status}
