"""Gaussians and step time over training: Fig. 3 of the supplement."""

import numpy as np

from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.errors import UserError
from mien.lab.analysis.context import Context
from mien.lab.analysis.result import Chart, PartResult, Table
from mien.pages.plots import Axes, Series

_PAPER_START, _PAPER_END = 10_144, 100_000
"""The supplement, section C: one Gaussian for each triangle at first, and about so many at the end, on average."""
_PAPER_SLOWER = 2.0
"""The supplement, section C: the time of a step at most doubles."""
_NEAR = 0.05
"""Share by which a number of Gaussians may differ from the first or the largest one to count as that one."""
_NOISY = 1.3
"""Ratio of the third and the first quartile of step times above which they are reported as uncertain."""
_WINDOWS = 60
"""Number of windows of a curve, each of which becomes its median."""
_BINS = 12
"""Number of bins of the number of Gaussians."""


def growth(context: Context) -> PartResult:
    """How the number of Gaussians and the time of a step grow over the run, from its curves."""
    config = context.avatar.config
    assert isinstance(config, GaussianAvatarsConfig)
    steps, gaussians, times = _entries(context)
    start, peak = float(gaussians[0]), float(gaussians.max())
    at_start, at_peak = times[gaussians <= start * (1 + _NEAR)], times[gaussians >= peak * (1 - _NEAR)]
    few, many = _median(at_start), _median(at_peak)
    grown, slower = peak / max(start, 1), many / max(few, 1e-9)
    memory = context.summary["peak_memory_mb"]
    ratio = f"Step time grows {slower:.1f} times while Gaussians grow {grown:.1f} times"
    values = {
        "gaussians_start": int(start),
        "gaussians_peak": int(peak),
        "gaussians_growth": round(grown, 3),
        "step_ms_start": round(few, 3),
        "step_ms_peak": round(many, 3),
        "step_time_growth": round(slower, 3),
        "training_peak_memory_mb": memory,
        "paper": {"gaussians_start": _PAPER_START, "gaussians_end": _PAPER_END, "step_time_growth_at_most": 2.0},
    }
    rows = (
        ("Gaussians at the start", int(start), _PAPER_START),
        ("Gaussians, most", int(peak), _PAPER_END),
        ("Gaussians grow, times", round(grown, 1), 10),
        ("Step, with Gaussians as at the start, ms", round(few, 1), None),
        ("Step, with the most Gaussians, ms", round(many, 1), None),
        ("Step time grows, times", round(slower, 2), "at most 2"),
        ("Memory of training, most, MB", round(memory), "fits 12 GB of a GPU"),
    )
    limit = config.density.max_gaussians
    notes = [
        "Step times are medians: over the steps with at most 5 % more Gaussians than at the start, and over those with "
        "at least 95 % of the most. Other work on the machine during training changes them.",
        "The paper's figures are those of section C of its supplement, for 600,000 steps on a GPU.",
        "Memory of training is that of the whole process, libraries and pictures included.",
    ]
    low, high = np.percentile(at_peak, (25, 75))
    if high > _NOISY * low:
        notes.append(
            f"The middle half of the steps with the most Gaussians takes {low:.1f} to {high:.1f} ms, so other work "
            "probably ran beside the training, and the growth of the step time is uncertain."
        )
    if peak >= limit * (1 - _NEAR):
        notes.append(f"The number of Gaussians ends at this run's limit, --method.density.max-gaussians {limit:,}.")
    return PartResult(
        values,
        (f"{ratio}. In the paper it at most doubles while Gaussians grow about 10 times.",),
        (Table(("", "This run", "Paper"), rows),),
        _charts(steps, gaussians, times, (start, few)),
        notes=tuple(notes),
    )


def _charts(
    steps: np.ndarray, gaussians: np.ndarray, times: np.ndarray, start: tuple[float, float]
) -> tuple[Chart, ...]:
    ends = np.array([steps[0], steps[-1]])
    paper = [
        Series("paper, at the start", ends, np.full(2, float(_PAPER_START)), "quiet"),
        Series("paper, at the end", ends, np.full(2, float(_PAPER_END)), "second"),
    ]
    number = Chart(
        "growth-gaussians",
        "Fig. 3a: number of Gaussians",
        (Series("this run", steps, gaussians), *paper),
        Axes("step", "Gaussians", from_zero=True),
    )
    time = Chart(
        "growth-step-time",
        "Fig. 3b: time of a step, ms",
        (Series("single steps", steps, _without_outliers(times), "quiet"), _medians("median", steps, times)),
        Axes("step", "ms", from_zero=True),
    )
    x, y = binned(gaussians, times)
    reach = max(10.0, float(gaussians.max()) / max(start[0], 1))
    line = np.array([1.0, reach])
    relative = Chart(
        "growth-ratio",
        "Step time over the number of Gaussians, both relative to the start",
        (
            Series("this run", x / max(start[0], 1), y / max(start[1], 1e-9)),
            Series("paper: at most", np.array([1.0, 10.0]), np.array([1.0, _PAPER_SLOWER]), "second"),
            Series("in proportion", line, line, "quiet"),
        ),
        Axes("Gaussians, times", "step time, times", from_zero=True),
        "The lower, the better: on the quiet line, a step takes as many times longer as there are more Gaussians.",
    )
    return number, time, relative


def _entries(context: Context) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step, number of Gaussians and step time of the entries of the curves in which all are finite."""
    curves = np.stack([context.curves[name] for name in ("step", "gaussians", "step_ms")])
    finite = curves[:, np.isfinite(curves).all(0)]
    if not finite.size:
        raise UserError(f"{context.run_dir}: its curves have no entry that is whole; train it again")
    return finite[0], finite[1], finite[2]


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def _without_outliers(values: np.ndarray) -> np.ndarray:
    """The values, cut at the 99th percentile, so that a few late steps do not flatten the rest."""
    return np.minimum(values, np.percentile(values, 99))


def _medians(label: str, x: np.ndarray, y: np.ndarray) -> Series:
    windows = [part for part in np.array_split(np.arange(len(x)), _WINDOWS) if len(part)]
    return Series(
        label, np.array([x[part].mean() for part in windows]), np.array([_median(y[part]) for part in windows])
    )


def binned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The medians of x and y in bins of x."""
    edges = np.linspace(x.min(), x.max(), _BINS + 1)
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _BINS - 1)
    filled = [bins == index for index in range(_BINS) if (bins == index).any()]
    return np.array([_median(x[here]) for here in filled]), np.array([_median(y[here]) for here in filled])
