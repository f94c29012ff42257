"""Measure this machine and this version of mien."""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mien.avatar.methods import DEFAULT_METHOD, METHODS
from mien.commands.train_options import check_method, listed_methods
from mien.disk.config import POSITIVE, Range
from mien.disk.files import check_writable
from mien.disk.workspace import open_workspace
from mien.errors import UserError
from mien.lab.benchmarking import GPU_BENCHMARKS, STEP_BENCHMARKS
from mien.lab.synthetic.recipe import PEOPLE
from mien.machine.devices import DeviceName, check_device, choose_device, like_on
from mien.machine.terminal import show
from mien.plugins import named

if TYPE_CHECKING:
    StepMethod = str
    CaptureName = str
else:
    StepMethod, CaptureName = Literal[tuple(GPU_BENCHMARKS)], Literal[tuple(PEOPLE["references"])]


@dataclass(frozen=True)
class _Timed:
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the machine and all rows as json, for programs."""
    seconds: Annotated[float, POSITIVE] = 0.8
    """Seconds to spend on each row. More time finds a smaller minimum on a busy machine."""


@dataclass(frozen=True)
class Render(_Timed):
    """Measure how fast the native core draws Gaussians, forward and backward, by size, threads and instruction set."""

    device: DeviceName = "cpu"
    """Device to draw on. cuda measures gsplat on a GPU, at the sizes of the papers."""

    def check(self) -> None:
        """Check that CUDA has gsplat."""
        check_device(self.device)

    def run(self) -> None:
        """Measure and print the rows."""
        from mien.lab.benchmarking.render import gpu_rows, render_suite

        device = choose_device(self.device)
        on_gpu = device.type == "cuda"
        rows = gpu_rows(like_on(device), self.seconds) if on_gpu else render_suite(self.seconds)
        show_rows(rows, self.as_json, gpu=on_gpu)


@dataclass(frozen=True)
class Scaling(_Timed):
    """Measure how drawing and training scale, by Gaussians, size, pictures and threads, and which share does not."""

    plot: Path | None = None
    """File for a chart, .svg (default: no chart)."""

    def check(self) -> None:
        """Check before any measurement that the chart can be written."""
        if self.plot is not None:
            if self.plot.suffix != ".svg":
                raise UserError(f"--plot {self.plot}: charts are written as .svg; give a name that ends so")
            check_writable(self.plot)

    def run(self) -> None:
        """Measure and print the rows, then draw the chart."""
        from mien.lab.benchmarking.scaling import scaling_suite, shares_that_do_not_scale, write_scaling_chart

        rows = show_rows(scaling_suite(self.seconds), self.as_json)
        if not self.as_json:
            show("\n".join(shares_that_do_not_scale(rows)))
        if self.plot is not None:
            write_scaling_chart(self.plot, rows)


@dataclass(frozen=True)
class TrainStep(_Timed):
    """Measure a training step (no footage is needed), and posing together with drawing."""

    method: StepMethod = DEFAULT_METHOD
    """Method to measure. All but the default are measured at 512x512, with the sizes of their papers or of the preset
    standard; some on a GPU only."""
    parts: bool = False
    """Measure the parts of a step of the default method on the CPU, with all of its losses: 45,000 Gaussians, 512x512.
    A part is a phase of the step, or a function of the native core in it. Figures are means over the steps of the
    fastest round."""
    seconds: Annotated[float, POSITIVE] = 3.0
    """Seconds to spend on each row. More time finds a smaller minimum on a busy machine."""
    device: DeviceName = "cpu"
    """Device to train on. cuda measures a GPU, where gsplat draws, at the sizes of the papers."""

    def check(self) -> None:
        """Check that CUDA has gsplat, and that the options fit together."""
        check_device(self.device)
        if self.method not in STEP_BENCHMARKS and self.device != "cuda":
            raise UserError(f"--method {self.method}: is measured on a GPU only; add --device cuda")
        if self.parts and self.method != DEFAULT_METHOD:
            raise UserError(f"--parts --method {self.method}: only {DEFAULT_METHOD} has parts; leave out one")
        if self.parts and self.device == "cuda":
            raise UserError("--parts --device cuda: parts are measured on the CPU only; leave out --device")

    def run(self) -> None:
        """Measure and print the rows."""
        if self.parts:
            from mien.lab.benchmarking.step_parts import format_parts, parts_suite

            show_rows(parts_suite(self.seconds), self.as_json, as_text=format_parts)
            return
        device = choose_device(self.device)
        if device.type == "cuda":
            show_rows(named(GPU_BENCHMARKS[self.method])(like_on(device), self.seconds), self.as_json, gpu=True)
        else:
            show_rows(named(STEP_BENCHMARKS[self.method])(self.seconds), self.as_json)


@dataclass(frozen=True)
class Quality:
    """Measure the quality of avatars and trackings: the whole path over reference captures, compared with the truth.

    Each capture is drawn (once), captured, tracked, trained and evaluated. A stopped command continues where it was.
    """

    captures: tuple[CaptureName, ...] = ()
    """Names of reference captures (default: all but ring-16-large, which takes hours, and unfilmed)."""
    method: Annotated[str, listed_methods("Method of the avatars")] = DEFAULT_METHOD
    steps: Annotated[int, Range(0, 1_000_000_000)] = 0
    """Number of optimiser steps. 0 means each capture's own number."""
    face_model: Literal["anny", "anny-bust"] = "anny"
    """Face model that is tracked. With a bust, errors of torsos and the motion of shoulders are printed as well."""
    out: Path = Path("out/bench-quality")
    """Folder for the drawn captures, the workspaces and the tables."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print all rows as json, for programs."""

    def check(self) -> None:
        """Check that there is such a method."""
        check_method("--method", self.method)

    def run(self) -> None:
        """Run every capture through all stages, then print the table."""
        from mien.pipeline.quality import run_quality_stage

        run_quality_stage(self.out, self.captures, self.method, self.steps, self.face_model, as_json=self.as_json)


@dataclass(frozen=True)
class Compare:
    """Compare methods: train and score each one on the same frames with the same budget, and print one table.

    The table has quality (head, eyes, mouth, whole frame, unseen views where there are any), Gaussians, training time,
    time a frame, and size on disk. A stopped command continues where it was. The runs are in the workspaces, named
    compare-METHOD-BUDGET, for `mien evaluate compare` and `mien study make`.
    """

    workspaces: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[DIR [DIR ...]]")] = ()
    """Tracked workspaces."""
    captures: tuple[CaptureName, ...] = ()
    """Reference captures as well. They are drawn, captured and tracked in --out first."""
    methods: Annotated[tuple[str, ...], listed_methods("Methods to compare")] = tuple(METHODS)
    minutes: Annotated[float, Range(0, 100_000)] = 0.0
    """Minutes of training for each method on each capture. Two short trials on this machine turn them into steps. 0
    means --steps."""
    steps: Annotated[int, Range(0, 1_000_000_000)] = 0
    """Number of optimiser steps of each method. 0 means the preset's own number for each method."""
    split: Literal["blocks", "tail"] = "blocks"
    """Held-out frames of workspaces: every fifth block of 10 frames (blocks), or the last 20 % (tail). Reference
    captures have their own. `mien batch --paper` compares methods by the split and protocol of a dataset."""
    device: DeviceName = "cpu"
    """Device to train on."""
    out: Path = Path("out/bench-compare")
    """Folder for the tables, trials and reference captures."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print the result as json, for programs."""

    def check(self) -> None:
        """Check without heavy libraries that there is something to compare, and that it can be written."""
        if not self.workspaces and not self.captures:
            raise UserError("nothing to compare on; give workspace folders, or --captures NAME")
        if self.minutes and self.steps:
            raise UserError(f"--minutes {self.minutes:g} --steps {self.steps}: give one of them")
        if not self.methods:
            raise UserError("--methods: give at least one method")
        for method in self.methods:
            check_method("--methods", method)
        names = [folder.resolve().name for folder in self.workspaces] + list(self.captures)
        if len({*names}) < len(names):
            twice = max(names, key=names.count)
            raise UserError(f"{twice}: two captures have this name; give one of them, or rename its folder")
        for folder in self.workspaces:
            open_workspace(folder)
        check_device(self.device)
        check_writable(self.out, folder=True)

    def run(self) -> None:
        """Train and score every method on every capture, then print the table."""
        from mien.pipeline.comparing import run_compare_stage

        run_compare_stage(
            self.out, [open_workspace(folder) for folder in self.workspaces], self.captures,
            list(dict.fromkeys(self.methods)), minutes=self.minutes, steps=self.steps, split=self.split,
            device=self.device, as_json=self.as_json,
        )  # fmt: skip


TASKS = {"render": Render, "train-step": TrainStep, "scaling": Scaling, "quality": Quality, "compare": Compare}


def show_rows(
    rows: Iterable[Any], as_json: bool, gpu: bool = False, as_text: Callable[[Any], str] | None = None
) -> list[Any]:
    """Print the machine, and each row (or list of rows) once it is measured, or everything as json, with one thread."""
    import torch

    from mien.lab.benchmarking.timing import format_machine, format_row, measure_machine

    torch.set_num_threads(1)
    machine, shown = measure_machine(gpu), []
    if not as_json:
        show(format_machine(machine))
    for row in rows:
        if not as_json:
            show(as_text(row) if as_text else format_row(row))
        shown += row if isinstance(row, list) else [row]
    if as_json:
        show(json.dumps({"machine": asdict(machine), "rows": [asdict(row) for row in shown]}))
    return shown
