"""`mien batch`: a table of captures in, an avatar for each row out."""

import importlib.util
import json
import shlex
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from mien.batch import Batch, EngineOptions, shard_of
from mien.errors import UserError
from mien.terminal import show

_WATCH_SECONDS = 5.0
_OF_TASKS = {"status": ("watch",), "table": ("rows", "columns")}
"""Options of one task only."""
_ENGINES = {"slurm": ("submitit",), "ray": ("ray",)}
"""Packages of the engines. One that is missing is told before the rows are read."""
NEEDS_TORCH = False
"""Rows run in processes of their own. Without torch, the driver of thousands stays small."""


@dataclass(frozen=True)
class Command:
    """Make an avatar from each row of a table, here, on a Slurm cluster, or on a Ray cluster (docs/scale.md).

    mien batch TABLE --out DIR: run all rows that are not done. The same command continues.

    mien batch status DIR: how far each row is, what failed and why, and when it will be done.

    mien batch table DIR: means by a column of the results, as Markdown and LaTeX.
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TABLE | status DIR | table DIR")]
    """A csv or json of captures, or a folder of videos. Or a task, and the folder of a batch."""
    out: Path | None = None
    """Folder of the batch, new or existing."""
    on: Literal["local", "slurm", "ray"] = "local"
    """What runs the rows: processes of this machine, a Slurm cluster (submitit), or a Ray cluster."""
    shard: str = ""
    """Run only rows I, I+N, ...: I/N with I from 1 to N. For Kubernetes, SkyPilot and GNU parallel."""
    retry: int = 2
    """How often a failed row is tried again."""
    jobs: int = 0
    """Largest number of rows at once. 0 means as many as memory and cores allow."""
    threads: int = 0
    """Threads of each row. 0 shares the cores out, or asks a cluster for two."""
    gpus: float = 0.0
    """GPUs of each row, on a cluster."""
    partition: str = ""
    """Partition of Slurm."""
    time: int = 0
    """Time limit of a row in minutes, for Slurm. 0 means three times the longest finished row, at first a day."""
    ray_address: str = ""
    """Address of a Ray cluster (default: RAY_ADDRESS, or a Ray that is started here)."""
    store: str = ""
    """URL of a folder for the workspaces, such as s3://bucket/people, if nodes share no folder. Copied in and out."""
    program: str = ""
    """Command that runs a row on a node, such as "apptainer exec mien.sif python -m mien.batch_row"."""
    watch: bool = False
    """Show the status again every five seconds, until all rows have ended."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the status, or the table, as json on standard output, for programs."""
    rows: str = "method"
    """Column of the results whose values are the lines of the table."""
    columns: str = "psnr,ssim,lpips"
    """Columns of the results whose means the table shows, separated by commas."""

    def check(self) -> None:
        """Check options and paths without heavy libraries."""
        from mien.files import check_writable

        task = self._task()
        if task is not None:
            if len(self.what) != 2:
                raise UserError(f"batch {task}: give the folder of one batch, as in `mien batch {task} people`")
            self._check_given("status" if task == "table" else "table", f"`mien batch {task}`")
            return  # the task reads the plan at once
        if len(self.what) != 1:
            raise UserError("give one table of captures, or one folder of videos; see mien batch --help")
        if self.out is None:
            raise UserError("--out is missing; give a folder for the batch")
        self._check_given("status", "a batch that runs")
        self._check_given("table", "a batch that runs")
        for package in _ENGINES.get(self.on, ()):
            if importlib.util.find_spec(package) is None:
                raise ModuleNotFoundError(f"No module named {package!r}", name=package)
        check_writable(self.out, folder=True)
        for name, value in (("retry", self.retry), ("jobs", self.jobs), ("threads", self.threads), ("time", self.time)):
            if not 0 <= value <= 100_000:
                raise UserError(f"--{name} {value}: give a number from 0 to 100000")
        if not 0 <= self.gpus <= 64:
            raise UserError(f"--gpus {self.gpus:g}: give a number from 0 to 64")
        if self.shard:
            shard_of([], self.shard)
        if self.store and self.on == "slurm":
            raise UserError("--store: is for local and ray; nodes of Slurm share a folder, so give that with --out")
        if self.store and "://" not in self.store:
            raise UserError(f"--store {self.store}: give a URL, such as s3://bucket/people or file:///mnt/people")
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

    def _check_given(self, task: str, where: str) -> None:
        """Check that no option of a task is given elsewhere, where it would change nothing."""
        defaults = {each.name: each.default for each in fields(self)}
        for name in _OF_TASKS[task]:
            if getattr(self, name) != defaults[name]:
                option = name.removeprefix("as_")
                raise UserError(f"--{option} is for `mien batch {task} DIR`, and not for {where}; leave it out")

    def _task(self) -> str | None:
        return self.what[0] if self.what and self.what[0] in ("status", "table") else None

    def _run_rows(self) -> None:
        from mien.batch import Driver, batch_progress, progress_text, write_results, write_wall
        from mien.commands.stages.batch_table import read_table
        from mien.progress import say

        assert self.out is not None
        batch, rows = Batch(self.out), read_table(Path(self.what[0]))
        labels = dict.fromkeys(label for row in rows for label in row.labels)
        if labels:
            say(f"labels, which come back in the results: {', '.join(labels)}")
        batch.write_plan(rows)
        program = tuple(shlex.split(self.program))
        options = EngineOptions(
            self.out, self.jobs, self.threads, self.gpus, self.time, self.partition, self.ray_address
        )
        driver = Driver(batch, self.on, options, self.retry, self.store, program)
        driver.run(shard_of(rows, self.shard) if self.shard else rows)
        write_wall(batch, write_results(batch))
        progress = batch_progress(batch)
        for line in progress_text(progress).splitlines():
            say(line)
        say(f"Look at {self.out / 'index.html'}; the figures are in {self.out / 'results.csv'}")
        failed = progress["counts"].get("failed", 0)
        if failed:
            raise UserError(
                f"{failed} of {len(rows)} rows failed; see `mien batch status {shlex.quote(str(self.out))}`"
            )

    def _status(self, batch: Batch) -> None:
        from mien.batch import batch_progress, progress_text

        while True:
            found = batch_progress(batch)
            show(json.dumps(found, indent=1) if self.as_json else progress_text(found))
            if not self.watch or not set(found["counts"]) & {"waiting", "running", "interrupted"}:
                return
            time.sleep(_WATCH_SECONDS)

    def _table(self, batch: Batch) -> None:
        from mien.batch import latex_table, markdown_table, means_by, result_rows
        from mien.files import write_atomically

        columns = [column.strip() for column in self.columns.split(",") if column.strip()]
        table = means_by(result_rows(batch), self.rows, columns)
        for name, text in (("table.md", markdown_table(table)), ("table.tex", latex_table(table))):
            write_atomically(batch.root / name, lambda aside, text=text: aside.write_text(text, encoding="utf-8"))
        show(json.dumps(table) if self.as_json else markdown_table(table).rstrip())
