"""The threshold of the scale loss, and what drawing costs without it: section C of the supplement."""

from dataclasses import replace

import numpy as np
import torch

from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.disk.files import file_digest
from mien.lab.analysis.context import Context, Variant, mean_psnr
from mien.lab.analysis.drawing import measure_in_turn
from mien.lab.analysis.result import Chart, PartResult, Table
from mien.pages.plots import Axes, Series
from mien.training.footage.frames import spread_frames

_LAST = 0.2
"""Share of a training, at its end, that step times are taken from."""
_FRAMES = 16
"""Largest number of held-out frames that are scored."""
_SIZE = (550, 802)
"""Width and height of the pictures that are timed: the paper's own."""


def scale(context: Context) -> PartResult:
    """The same short training with the threshold of the scale loss, and with a threshold of 0."""
    config = context.avatar.config
    assert isinstance(config, GaussianAvatarsConfig)
    usual = GaussianAvatarsConfig()
    threshold = config.scale_threshold or usual.scale_threshold
    context.say_how_long("scale", 2)
    names = (f"threshold {threshold:g}", "no threshold (0)")
    variants = [
        context.train("scale-threshold", replace(config, scale_threshold=threshold)),
        context.train("scale-no-threshold", replace(config, scale_threshold=0.0)),
    ]
    key = [[file_digest(one.run_dir / "avatar" / "avatar.safetensors") for one in variants], context.options.seconds]
    avatars = {name: one.avatar for name, one in zip(("with", "without"), variants, strict=True)}
    camera = context.camera.fitted(*_SIZE)
    drawn = context.kept("scale-drawing", key, lambda: measure_in_turn(avatars, camera, context.options.seconds))
    draw_ms = [drawn["with"], drawn["without"]]
    step_ms = [_late_step_ms(one) for one in variants]
    scores = [_score(context, one) for one in variants]
    sizes = [_scales(one) for one in variants]
    rows = tuple(
        (name, one.summary["gaussians"], round(size, 3), round(step, 1), round(draw, 1), score)
        for name, one, size, step, draw, score in zip(names, variants, sizes, step_ms, draw_ms, scores, strict=True)
    )
    slower_step, slower_draw = step_ms[1] / max(step_ms[0], 1e-9), draw_ms[1] / max(draw_ms[0], 1e-9)
    columns = ("name", "gaussians", "median_scale", "step_ms", "draw_ms", "head_psnr")
    values = {
        "steps": context.options.steps,
        "rows": [dict(zip(columns, row, strict=True)) for row in rows],
        "step_slower_without": round(slower_step, 3),
        "drawing_slower_without": round(slower_draw, 3),
    }
    heading = (
        "", "Gaussians", "Median scale, triangle units", "Step at the end, ms", "Drawing 550x802, ms",
        "PSNR of the head crop, dB",
    )  # fmt: skip
    return PartResult(
        values,
        _findings(context, (slower_step, slower_draw), sizes, scores),
        (Table(heading, rows),),
        _charts(names, variants),
        notes=(
            "With a threshold of 0, the loss shrinks every Gaussian. The supplement expects that more of them are then "
            "blended before a ray ends. Both trainings have the same settings, seed and frames.",
            "Drawing is timed in turn, so that other work on the machine slows both alike. Steps are timed one "
            "training after the other.",
        ),
    )


def _findings(
    context: Context, slower: tuple[float, float], sizes: list[float], scores: list[float | None]
) -> tuple[str, ...]:
    """The result in words. Pairs of figures are those with the threshold, then without."""
    found = [
        f"Without the threshold, a step takes {slower[0]:.2f} times as long at the end and drawing {slower[1]:.2f} "
        f"times as long, after {context.options.steps:,} steps. The supplement says, without a figure, that drawing "
        "would become substantially slower."
    ]
    if scores[0] is not None and scores[1] is not None:
        found.append(
            f"The median of the scales is {sizes[1]:.2g} of a triangle without the threshold and {sizes[0]:.2g} with "
            f"it; PSNR of the head crop is {scores[1]:.2f} dB without and {scores[0]:.2f} dB with it."
        )
    return tuple(found)


def _late_step_ms(variant: Variant) -> float:
    times = variant.curves["step_ms"]
    return float(np.median(times[-max(1, round(_LAST * len(times))) :]))


def _scales(variant: Variant) -> float:
    """The median, over the Gaussians, of the largest scale in units of the triangle."""
    return float(torch.exp(variant.avatar.gaussian_store()["log_scales"].detach()).amax(-1).median())


def _score(context: Context, variant: Variant) -> float | None:
    experiment = context.experiment(variant.run_dir)
    if experiment is None:
        return None
    return round(mean_psnr(experiment, spread_frames(experiment.held_out_frames, _FRAMES)), 2)


def _charts(names: tuple[str, str], variants: list[Variant]) -> tuple[Chart, ...]:
    charts = []
    for curve, title in (("step_ms", "Time of a step, ms"), ("gaussians", "Number of Gaussians")):
        series = []
        for name, variant, style in zip(names, variants, ("main", "second"), strict=True):
            values = variant.curves[curve]
            if curve == "step_ms":
                values = _smooth(np.minimum(values, np.percentile(values, 98)))
            series.append(Series(name, variant.curves["step"], values, style))
        name = f"scale-{curve.replace('_', '-')}"
        charts.append(Chart(name, title, tuple(series), Axes("step", title, from_zero=True)))
    return tuple(charts)


def _smooth(values: np.ndarray) -> np.ndarray:
    """The running median over a twentieth of the curve."""
    reach = max(1, len(values) // 40)
    return np.array([np.median(values[max(0, i - reach) : i + reach + 1]) for i in range(len(values))])
