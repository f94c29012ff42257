"""`mien bench render | train-step | scaling` writes rows, json and charts that say what was measured."""

import importlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from known import known
from mien import _native
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.methods import METHODS
from mien.cli import main
from mien.face import load_face_model
from mien.lab.benchmarking import GPU_BENCHMARKS, method_steps, scaling, step_parts, train_step
from mien.lab.benchmarking import render as render_benchmark
from mien.lab.benchmarking.timing import BenchmarkRow, Timing, benchmark_row, thread_counts, time_function
from mien.plugins import named
from mien.training.trainer import step
from refusals import complaint

pytestmark = pytest.mark.unchecked


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
    _native.set_thread_count(0)


def test_timing_counts_every_run_and_orders_its_figures() -> None:
    runs: list[int] = []
    timing = time_function(lambda: runs.append(sum(range(10_000))), seconds=0.0, min_runs=5)
    assert len(runs) == 7  # two of which warm up
    assert 0 < timing.min_ms <= timing.median_ms
    assert timing.cpu_ms > 0
    # Times of a step are those of one frame.
    state, _ = method_steps.mono_case(load_face_model(), 3000, (64, 48), frames=4)
    assert state.avatar.extras.frames_per_step(0.0) == 4
    row = method_steps.per_frame(benchmark_row("a step", 3000, (64, 48), Timing(8.0, 12.0, 16.0)), 4)
    assert (row.min_ms, row.median_ms, row.cpu_ms) == (2.0, 3.0, 4.0)
    # Waiting for a picture is measured with the worker and without.
    rows = list(train_step.waiting_rows(load_face_model(), 500, (64, 48), 0.01))
    assert [row.name for row in rows] == ["wait_for_target", "make_target"]
    assert all(0 < row.min_ms <= row.median_ms and row.cpu_ms > 0 for row in rows)


def test_scaling_as_json_with_a_chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(scaling, "COUNTS", (5, 20))
    monkeypatch.setattr(scaling, "SIZES", ((40, 30), (32, 32)))
    monkeypatch.setattr(scaling, "COUNT", 30)
    small = train_step.training_case(load_face_model(), 2_000, 48, 40)
    monkeypatch.setattr(scaling, "default_case", lambda face_model: (*small, train_step.SETTINGS))
    chart = tmp_path / "chart.svg"
    assert main(["bench", "scaling", "--json", "--seconds", "0.001", "--plot", str(chart)]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["machine"]["gflops"] > 0
    rows = [BenchmarkRow(**row) for row in shown["rows"]]
    drawn, others = ([row for row in rows if row.name.startswith("rasterize_f") == which] for which in (True, False))
    wanted = itertools.product(((40, 30), (32, 32)), (5, 20), thread_counts())
    assert {((row.width, row.height), row.gaussians, row.threads) for row in drawn} == set(wanted)
    names = ["train_step_default", *(f"rasterize_{pictures}_at_once" for pictures in (1, 2, 4, 8))]
    assert {row.name for row in others} == set(names)
    assert {row.threads for row in others} >= set(thread_counts())
    assert all(0 < row.min_ms <= row.median_ms for row in rows)
    titles = ("rasterize forward, 1 thread", "40x30", "32x32", "30 Gaussians by threads", "rasterize 8 at once")
    assert all(words in chart.read_text() for words in titles)


def test_the_share_that_does_not_scale_is_amdahls() -> None:
    def row(name: str, threads: int, ms: float) -> BenchmarkRow:
        return replace(benchmark_row(name, 9, (64, 48), Timing(ms, ms, ms)), threads=threads)

    rows = [row("whole", 1, 8.0), row("whole", 2, 5.0), row("whole", 4, 3.5), row("none", 1, 8.0), row("none", 4, 2.0)]
    first, second = scaling.shares_that_do_not_scale([*rows, row("alone", 1, 8.0)])
    assert "whole" in first
    assert "25 % does not scale (2.29 times as fast with 4 threads)" in first
    assert " 0 % does not scale (4.00 times" in second


def test_instruction_sets_are_compared_and_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_benchmark, "COUNTS", ())
    monkeypatch.setattr(
        render_benchmark, "head_scene", lambda *_, head_scene=render_benchmark.head_scene: head_scene(9, 8, 8)
    )
    best = _native.rasterize_isa()
    shown = [row.isa for row in render_benchmark.render_suite(0.0)]
    assert shown[0] == best
    assert len(shown) == 2 * len(set(shown))
    assert _native.rasterize_isa() == best


MOST_OPERATORS = 285
"""Most operators of PyTorch for a frame of the default, nested ones included: a mean over steps with and without rare
losses. PyTorch's own engine has 60 of them."""


def test_parts_of_a_step_add_up_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that a step does is in some row, each native operation in its own, and nothing stays watched."""
    reads: list[int] = []
    clock = SimpleNamespace(perf_counter=lambda: (reads.append(1) or len(reads)) / 1000)
    monkeypatch.setattr(step_parts, "time", clock)
    monkeypatch.setattr(step_parts, "ROUND", 16)
    state, data, settings = step_parts.default_case(load_face_model(), 9_500, (96, 80))
    before = dict(vars(_native))
    rows = step_parts.step_parts(state, data, settings, seconds=0.001)
    # A step's first look at the clock ends nothing, nor do those before and after the round.
    assert sum(row.ms for row in rows) == pytest.approx((len(reads) - 2) / step_parts.ROUND - 1)
    found = {(row.phase, row.operation) for row in rows}
    rest = step_parts.REST
    assert len(found) == len(rows)
    assert found >= {
        ("pose and draw", "rasterize_views"), ("pose and draw", "ride"), ("pose and draw", rest),
        ("losses of pictures", "photometric_loss"), ("perceptual loss", rest), ("backward", "rasterize_views_backward"),
        ("side views", "rasterize_mesh"), ("update", "adam_update"), ("update", "factored_update"),
        ("after update", "keep_on_surface"), ("after backward", "clear_rows"), ("other", rest),
    }  # fmt: skip
    assert dict(vars(_native)) == before
    shown = step_parts.format_parts(rows)
    assert "a step, " in shown
    assert shown.count("ride_changes_backward") == 1
    drawn = sum(row.ms for row in rows if row.operation in ("rasterize_views", "rasterize_views_backward"))
    assert shown.endswith(f"{sum(row.ms for row in rows) / drawn:.2f} times")
    before = state.step
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        for _ in range(50):
            step(state, data, settings)
    assert len(list(known(profile.events()))) / (state.step - before) < MOST_OPERATORS


@pytest.mark.parametrize(
    ("made", "count", "name", "shape"),
    [
        (lambda: method_steps.headgas_case(load_face_model(), HeadGasConfig(features=4), 500, (96, 80)), 3, "bases",
         (500, 20, 4)),
        (lambda: method_steps.mono_case(load_face_model(), 4000, (96, 80)), 3, "means", (4000, 3)),
        (lambda: train_step.training_case(load_face_model(), 2000, 96, 80), 10, "sh_constant", (2000, 1, 3)),
    ],
)  # fmt: skip
def test_a_case_trains(made: Any, count: int, name: str, shape: tuple[int, ...]) -> None:
    """The benchmarked step is the trainer's own, on pictures from which it can learn."""
    state, data = made()
    begun, before = state.step, state.avatar.store[name].detach().clone()
    matte = data.targets[0].target(0, 0, np.full(3, 255, np.uint8), keep=False).matte
    assert 0.2 < (matte > 127).float().mean() < 0.8, "the head fills about half of the picture"
    for _ in range(count):
        step(state, data, train_step.SETTINGS)
    assert (state.step - begun, before.shape) == (count, shape)
    assert not torch.equal(before, state.avatar.store[name])


def test_what_a_gpu_would_be_measured_with_runs_in_plain_pytorch(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """The cases of a GPU run in float64 on the CPU, which executes all of their code but gsplat's."""
    for room in (render_benchmark, train_step, method_steps):
        monkeypatch.setattr(room, "GPU_COUNTS", (60,))
        monkeypatch.setattr(room, *(("_SIZE", (24, 16)) if room is method_steps else ("PAPER_SIZES", {"": (24, 16)})))
    like = torch.zeros((), dtype=torch.float64)
    rows = [*render_benchmark.gpu_rows(like, 0.0), *train_step.gpu_rows(like, 0.0)]
    names = ["rasterize_forward", "rasterize_forward_backward", "train_step", "pose_and_render"]
    assert [row.name for row in rows] == names
    for name in GPU_BENCHMARKS.keys() - {"gaussian_avatars"}:
        rows += named(GPU_BENCHMARKS[name])(like, 0.0)
    assert [row.name for row in rows[4:]] == ["train_step"] * 4
    assert all((row.gaussians, row.width, row.height) == (60, 24, 16) and row.min_ms > 0 for row in rows)
    if not torch.cuda.is_available():
        assert "--device cuda" in complaint(capsys, "bench", "render", "--device", "cuda")


def test_parts_for_a_gpu_tell_how_far_they_came(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two of the parts are stopped when their time is over, and one fails."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    device = importlib.import_module("device")
    asked: dict[str, float] = {}
    curve = "stage 4 of 5 (training)\ntraining: 80/600000 in 20 s; PSNR 24.1 dB\nInterrupted\n"
    steps = {"rows": [{"name": "train_step", "gaussians": 30_000, "width": 550, "height": 802, "median_ms": 4.21}]}

    def run(name: str, command: list[str], seconds: float) -> tuple[int, str, str]:
        asked[name] = seconds
        if name == "tests":
            return 0, "== 31 passed in 60 s ==\n", ""
        if name.startswith("step-"):
            return (1, "", "out of memory\n") if "headgas" in name else (0, json.dumps(steps), "")
        return (0, "", "Done in 99 s. Stages: a 9 s.\nNext\n") if name == "create" else (124, "", curve)

    clock = device.Clock(math.inf)
    rows = {row.part: row.result for row in device.rows(run, tuple(METHODS), tmp_path / "a.mp4", tmp_path, clock)}
    papers = [f"paper-{name}" for name in METHODS if "paper" in METHODS[name].presets]
    assert list(rows) == ["tests", *(f"step-{name}" for name in METHODS), "create", *papers]
    assert (rows["tests"], rows["create"]) == ("31 passed in 60 s", "Done in 99 s. Stages: a 9 s.")
    assert (rows["step-headgas"], rows["step-mono_gaussian_avatar"]) == (
        "failed (1): out of memory", "30,000 at 550x802: 4.21 ms",
    )  # fmt: skip
    assert rows[papers[0]].endswith("s; training: 80/600000 in 20 s; PSNR 24.1 dB")
    assert sum(asked[name] for name in asked if not name.startswith("paper-")) < device.BUDGET
    assert asked[papers[0]] == device.BUDGET / len(papers)


@pytest.mark.gpu
@pytest.mark.parametrize("what", ["render", "train-step"])
def test_a_gpu_is_measured(what: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for room in (render_benchmark, train_step):
        monkeypatch.setattr(room, "GPU_COUNTS", (1000,))
    assert main(["bench", what, "--device", "cuda", "--json", "--seconds", "0.001"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["machine"]["gpu"]
    assert {(row["isa"], row["threads"]) for row in shown["rows"]} == {("cuda", 0)}
