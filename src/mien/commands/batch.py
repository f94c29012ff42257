"""`mien batch`: a table of captures in, an avatar for each row out."""

import importlib.util
import json
import shlex
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mien.batch.drive import MODULES_OF_ENGINES, OPTIONS_OF_ENGINES, shard_of
from mien.batch.plan import Batch, Options
from mien.errors import UserError
from mien.machine.terminal import show

_WATCH_SECONDS = 5.0
_TASKS = {
    "status": ("what", "watch", "as_json"),
    "table": ("what", "rows", "columns", "as_json"),
}
"""Options that a task has. Elsewhere they would change nothing."""
_OF_ENGINES = ("out", "for_all", "on", "shard", "retry", "jobs", "threads", "program")
"""Options that a batch has on every engine. `OPTIONS_OF_ENGINES` names others."""


@dataclass(frozen=True)
class Command:
    """Make an avatar from each row of a table, here, on a Slurm cluster, or on a Ray cluster (docs/scale.md).

    mien batch TABLE --out DIR: run all rows that are not done. The same command continues. Options of `mien create`,
    such as --preset draft, count for all rows; a cell of the table goes first.

    mien batch status DIR: how far each row is, what failed and why, and when it will be done.

    mien batch table DIR: means by a column of the results, as Markdown and LaTeX.
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TABLE | status DIR | table DIR")]
    """A csv or json of captures, or a folder of videos. Or a task, and the folder of a batch."""
    out: Path | None = None
    """Folder of the batch, new or existing. Needed to run rows."""
    on: Literal["local", "slurm", "ray"] = "local"
    """What runs the rows: processes of this machine, a Slurm cluster (submitit), or a Ray cluster."""
    shard: str = ""
    """Run only rows I, I+N, ..., given as I/N with I from 1 to N. For Kubernetes, SkyPilot and GNU parallel."""
    retry: int = 2
    """How often a failed row is tried again."""
    jobs: int = 0
    """Largest number of rows at once. 0 means as many as memory and cores allow."""
    threads: int = 0
    """Threads of each row. 0 shares the cores out, or asks a cluster for two."""
    gpus: float = 0.0
    """GPUs of each row, on Slurm and Ray."""
    partition: str = ""
    """Partition of Slurm."""
    time: int = 0
    """Time limit of a row in minutes, for Slurm. 0 means three times the longest finished row, at first a day."""
    ray_address: str = ""
    """Address of a Ray cluster (default: RAY_ADDRESS, or a Ray that is started here)."""
    store: str = ""
    """URL of a folder for the workspaces, such as s3://bucket/people, if nodes share no folder. Copied in and out."""
    program: str = ""
    """Command that runs a row on a node, such as "apptainer exec mien.sif python -m mien.commands.batch_row". The
    folder of the batch follows it."""
    watch: bool = False
    """For status: show it again every five seconds, until all rows have ended."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """For status and table: print json on standard output, for programs."""
    rows: str = "method"
    """For table: column of the results whose values are its lines."""
    columns: str = "psnr,ssim,lpips"
    """For table: columns of the results whose means it shows, separated by commas."""
    for_all: Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress] = None
    """Options of `mien create`, as `for_all_rows` finds them in what was typed."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.disk.files import check_writable

        task = self._task()
        if task is not None:
            if len(self.what) != 2:
                raise UserError(f"batch {task}: give the folder of one batch, as in `mien batch {task} people`")
            self._check_given(task)
            return  # the task reads the plan at once
        if len(self.what) != 1:
            raise UserError("give one table of captures, or one folder of videos; see mien batch --help")
        if self.out is None:
            raise UserError("--out is missing; give a folder for the batch")
        self._check_given(self.on)
        module = MODULES_OF_ENGINES.get(self.on)
        if module is not None and importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)
        check_writable(self.out, folder=True)
        for name, value in (("retry", self.retry), ("jobs", self.jobs), ("threads", self.threads), ("time", self.time)):
            if not 0 <= value <= 100_000:
                raise UserError(f"--{name} {value}: give a number from 0 to 100000")
        if not 0 <= self.gpus <= 64:
            raise UserError(f"--gpus {self.gpus:g}: give a number from 0 to 64")
        if self.shard:
            shard_of([], self.shard)
        if self.store and "://" not in self.store:
            raise UserError(f"--store {self.store}: give a URL, such as s3://bucket/people or file:///mnt/people")
        if self.store:
            from mien.batch.store import store_of

            store_of(self.store)
        self._program()
        if not Path(self.what[0]).exists():
            raise UserError(f"{self.what[0]}: no such file or folder; give a table of captures, or a folder of videos")

    def run(self) -> None:
        """Run the task that is asked for."""
        task = self._task()
        if task == "status":
            self._status(Batch(Path(self.what[1])))
        elif task == "table":
            self._table(Batch(Path(self.what[1])))
        else:
            self._run_rows()

    def _check_given(self, task: str) -> None:
        """Check that no option is given which the task does not have."""
        known = _TASKS.get(task) or (*_OF_ENGINES, *OPTIONS_OF_ENGINES[task])
        for each in fields(self):
            value, name = getattr(self, each.name), each.name.removeprefix("as_").replace("_", "-")
            name = ", --".join(self.for_all) if each.name == "for_all" and self.for_all else name
            if each.name != "what" and each.name not in known and value != each.default:
                where = f"`mien batch {task}`" if task in ("status", "table") else f"a batch that runs on {task}"
                raise UserError(f"--{name}: changes nothing for {where}; leave it out")

    def _task(self) -> str | None:
        return self.what[0] if self.what and self.what[0] in ("status", "table") else None

    def _program(self) -> tuple[str, ...]:
        try:
            return tuple(shlex.split(self.program))
        except ValueError as error:
            raise UserError(f"--program {self.program}: {error}; write it as in a shell") from None

    def _run_rows(self) -> None:
        from mien.batch.drive import drive
        from mien.batch.progress import batch_progress, progress_text
        from mien.batch.results import write_results
        from mien.batch.wall import write_wall
        from mien.commands.batch_table import read_table
        from mien.machine.progress import say
        from mien.machine.terminal import counted

        assert self.out is not None
        batch, rows = Batch(self.out), read_table(Path(self.what[0]), self.for_all)
        labels = dict.fromkeys(label for row in rows for label in row.labels)
        if labels:
            say(f"labels, which come back in the results: {', '.join(labels)}")
        self._tell_dropped(batch, {row.name for row in rows})
        batch.write_plan(rows)
        cluster = (self.gpus, self.time, self.partition, self.ray_address)
        options = Options(
            self.on, self.jobs, self.threads, *cluster, retry=self.retry, store=self.store, program=self._program()
        )
        drive(batch, shard_of(rows, self.shard) if self.shard else rows, options)
        write_wall(batch, write_results(batch))
        progress = batch_progress(batch)
        for line in progress_text(progress).splitlines():
            say(line)
        say(f"Look at {self.out / 'index.html'}; the figures are in {self.out / 'results.csv'}")
        failed = progress["counts"].get("failed", 0)
        if failed:
            raise UserError(
                f"{failed} of {counted(len(rows), 'row')} failed; see `mien batch status {shlex.quote(str(self.out))}`"
            )

    def _tell_dropped(self, batch: Batch, names: set[str]) -> None:
        """Say which rows of an earlier table are no longer in the plan."""
        from mien.machine.progress import say
        from mien.machine.terminal import counted

        try:
            dropped = [row.name for row in batch.read_plan() if row.name not in names]
        except UserError:  # there is none, or it is damaged and will be replaced
            return
        if dropped:
            shown = ", ".join(dropped[:5]) + (", ..." if len(dropped) > 5 else "")
            say(f"{counted(len(dropped), 'row')} of an earlier table will not be listed any more ({shown}); files stay")

    def _status(self, batch: Batch) -> None:
        from mien.batch.progress import batch_progress, progress_text

        while True:
            found = batch_progress(batch)
            show(json.dumps(found, indent=1) if self.as_json else progress_text(found))
            if not self.watch or not set(found["counts"]) & {"waiting", "running", "interrupted"}:
                return
            time.sleep(_WATCH_SECONDS)

    def _table(self, batch: Batch) -> None:
        from mien.batch.results import latex_table, markdown_table, means_by, result_rows
        from mien.disk.files import write_atomically

        columns = [column.strip() for column in self.columns.split(",") if column.strip()]
        rows, folder = result_rows(batch), shlex.quote(str(batch.root))
        if not any(row.get("method") for row in rows):
            raise UserError(
                f"{batch.root}: no row is done yet, so there is nothing to show; see `mien batch status {folder}`"
            )
        table = means_by(rows, self.rows, columns)
        for name, text in (("table.md", markdown_table(table)), ("table.tex", latex_table(table))):
            write_atomically(batch.root / name, lambda aside, text=text: aside.write_text(text, encoding="utf-8"))
        show(json.dumps(table) if self.as_json else markdown_table(table).rstrip())
