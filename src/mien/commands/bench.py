"""`mien bench`."""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mien.commands.options import MethodName
from mien.devices import DeviceName, check_device, choose_device, like_on
from mien.errors import UserError
from mien.terminal import show

if TYPE_CHECKING:
    import torch

    from mien.benchmarking.timing import BenchmarkRow, Machine


CaptureName = Literal["mono-short", "mono-long", "ring-16", "beard", "long-hair", "glasses", "off-model"]
"""The keys of `mien.synthetic.REFERENCES` (a test compares them): options are read before torch is imported."""


@dataclass(frozen=True)
class Render:
    """How fast the native core draws Gaussians on this machine, forward and backward, by size, threads and CPU kind."""

    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the machine and a list of rows for programs."""
    seconds: float = 0.8
    """To spend on each row; more finds a smaller minimum on a busy machine."""
    device: DeviceName = "cpu"
    """cuda: gsplat on a GPU instead, at the papers' sizes."""

    def check(self) -> None:
        """Tell that CUDA lacks gsplat, or that there is no time to measure in."""
        check_device(self.device)
        _check_seconds(self.seconds)

    def run(self) -> None:
        """Measure and print."""
        from mien.benchmarking.render import render_suite

        like = _gpu(self.device)
        if like is None:
            show_rows(render_suite(self.seconds), self.as_json)
            return
        from mien.benchmarking.device import render_rows

        show_rows(render_rows(like, self.seconds), self.as_json, gpu=True)


@dataclass(frozen=True)
class Scaling:
    """How drawing scales: 10,000 to 300,000 Gaussians, at the sizes that papers report and up to 2048x2048."""

    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the machine and a list of rows for programs."""
    seconds: float = 0.8
    """To spend on each row; more finds a smaller minimum on a busy machine."""
    plot: Path | None = None
    """Write a chart here: .png, .svg or .pdf."""

    def check(self) -> None:
        """Find out before any measuring whether the chart can be written, and whether there is time to measure in."""
        from mien.benchmarking.chart_path import check_chart_path

        _check_seconds(self.seconds)
        if self.plot is not None:
            check_chart_path(self.plot)

    def run(self) -> None:
        """Measure, print and draw."""
        from mien.benchmarking.charts import write_scaling_chart
        from mien.benchmarking.render import scaling_suite

        machine, rows = show_rows(scaling_suite(self.seconds), self.as_json)
        if self.plot is not None:
            write_scaling_chart(self.plot, rows, machine)


@dataclass(frozen=True)
class TrainStep:
    """How long a `gaussian_avatars` step takes as `mien train` runs it (no footage needed), and posing with drawing."""

    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the machine and a list of rows for programs."""
    seconds: float = 3.0
    """To spend on each row; more finds a smaller minimum on a busy machine."""
    device: DeviceName = "cpu"
    """cuda: on a GPU instead (gsplat draws), at the papers' sizes."""

    def check(self) -> None:
        """Tell that CUDA lacks gsplat, or that there is no time to measure in."""
        check_device(self.device)
        _check_seconds(self.seconds)

    def run(self) -> None:
        """Measure and print."""
        from mien.benchmarking.train_step import train_step_suite

        like = _gpu(self.device)
        if like is None:
            show_rows(train_step_suite(self.seconds), self.as_json)
            return
        from mien.benchmarking.device import train_step_rows

        show_rows(train_step_rows(like, self.seconds), self.as_json, gpu=True)


@dataclass(frozen=True)
class Quality:
    """How good the avatars and trackings are: the whole path over reference captures, with figures against the truth.

    Each capture is drawn (once), captured, tracked, trained and evaluated; a stopped command goes on where it was.
    """

    captures: tuple[CaptureName, ...] = ()
    """Names of reference captures (default: all)."""
    method: MethodName = "gaussian_avatars"
    """How the avatars are made."""
    steps: int = 0
    """Optimiser steps; 0 for each capture's own number."""
    out: Path = Path("out/bench-quality")
    """Folder for the drawn captures, the workspaces and the tables."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print a list of rows for programs."""

    def check(self) -> None:
        """Tell a negative number of steps."""
        if self.steps < 0:
            raise UserError(f"--steps {self.steps}: give a positive number, or 0 for each capture's own")

    def run(self) -> None:
        """Walk every capture, then print the table."""
        from mien.commands.stages.quality import quality_stage

        quality_stage(self.out, self.captures, self.method, self.steps, as_json=self.as_json)


@dataclass(frozen=True)
class Command:
    """Measure this machine and this version of mien: `mien bench render`, `train-step`, `scaling`, `quality`."""

    what: Annotated[
        Annotated[Render, tyro.conf.subcommand("render", prefix_name=False)]
        | Annotated[TrainStep, tyro.conf.subcommand("train-step", prefix_name=False)]
        | Annotated[Scaling, tyro.conf.subcommand("scaling", prefix_name=False)]
        | Annotated[Quality, tyro.conf.subcommand("quality", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]

    def check(self) -> None:
        """Tell what can be told before the chosen benchmark."""
        self.what.check()

    def run(self) -> None:
        """Run the chosen benchmark."""
        self.what.run()


def _check_seconds(seconds: float) -> None:
    if not 0 < seconds < math.inf:
        raise UserError(f"--seconds {seconds:g}: give a positive number; each row is measured for as long")


def _gpu(name: DeviceName) -> "torch.Tensor | None":
    """A scalar on the GPU that was asked for, None where it is the processor."""
    device = choose_device(name)
    return like_on(device) if device.type == "cuda" else None


def show_rows(rows: "Iterator[BenchmarkRow]", as_json: bool, gpu: bool = False) -> "tuple[Machine, list[BenchmarkRow]]":
    """Print the machine and every row as soon as it is measured, or all of it as json; torch keeps to one thread."""
    import torch

    from mien.benchmarking.timing import format_machine, format_row, measure_machine

    torch.set_num_threads(1)
    machine, shown = measure_machine(gpu), []
    if not as_json:
        show(format_machine(machine))
    for row in rows:
        shown.append(row)
        if not as_json:
            show(format_row(row))
    if as_json:
        show(json.dumps({"machine": asdict(machine), "rows": [asdict(row) for row in shown]}))
    return machine, shown
