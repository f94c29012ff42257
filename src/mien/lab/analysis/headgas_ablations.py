"""The ablations of HeadGaS (Dhamo et al., ECCV 2024): the same short training for each variant of Table 1."""

import math
from dataclasses import replace
from typing import Any, get_args

from mien.avatar.headgas.settings import HeadGasConfig, Variant
from mien.evaluation.experiment import Experiment
from mien.face.params import FaceParams
from mien.lab.analysis import measuring
from mien.lab.analysis.result import Result, Table
from mien.lab.analysis.running import Context, Run
from mien.training.footage.frames import Frame

ABLATIONS: dict[str, tuple[str, int | None, float | None, float]] = {
    "no_blending": ("without blending", 135_000, 8.0, 29.38),
    "change_all": ("change all", 97_000, 12.0, 29.65),
    "delta": ("with delta(mu, R)", 234_000, 19.0, 29.83),
    "no_mlp": ("without the network", 295_000, 10.0, 32.08),
    "no_perceptual": ("without the perceptual loss", None, None, 32.11),
    "full": ("full", 28_000, 4.0, 32.50),
}
"""Variant -> its name, and Gaussians, milliseconds of a frame and PSNR in the paper, in the order of its Table 1."""
TIMED_SIDE = 512
"""Side of the pictures of ablations that are timed."""
PLATEAU = 0.1
"""Least gain in dB for which the network without blending gets twice as wide (`--widen`)."""
_MOST_WIDTH = 2048


def busy_face(context: Context) -> FaceParams:
    """The subject with all expressions at a tenth of their largest bound, so that every basis is read."""
    subject, bounds = context.avatar.subject, context.avatar.face_model.expression_bounds
    return replace(subject, expression=subject.expression + 0.1 * bounds[:, 1])


def ablations(context: Context) -> Result:
    """The same short training for each variant of Table 1: Gaussians, time of a frame, scores of held-out frames."""
    config = context.avatar.config
    assert isinstance(config, HeadGasConfig)
    configs = ablation_configs(config)
    context.say_how_long("ablations", len(configs))
    runs = {name: context.train(f"ablation-{name.replace('_', '-')}", one) for name, one in configs.items()}
    metric, notes = measuring.perceptual_metric()
    widths: dict[int, float] = {}
    if context.options.widen:
        runs["no_blending"], widths = widened(context, configs["no_blending"], runs["no_blending"])
        found = ", ".join(f"{width} {score:.2f}" for width, score in widths.items())
        notes.append(f"PSNR of the head without blending by the width of its layers, in dB: {found or 'not scored'}.")
    camera, face = context.camera.fitted(TIMED_SIDE, TIMED_SIDE), busy_face(context)
    rows: list[dict[str, Any]] = []
    for name, run in runs.items():
        drawn = measuring.measure_drawing(run.timed_avatar, camera, context.options.seconds, face)
        row = {"gaussians": run.summary["gaussians"], "frame_ms": round(drawn["draw_ms"] + drawn["pose_ms"], 2)}
        rows.append({"name": name, **row, **measuring.held_out_scores(run, metric)})
    if "no_perceptual" not in configs:
        notes.append(
            "This run has no perceptual loss, so there is no row without it; train the run with "
            "--method.photometric.perceptual.weight above 0 to compare."
        )
    cells = []
    for row in rows:
        label, *paper = ABLATIONS[row["name"]]
        cells.append((label, row["gaussians"], round(row["frame_ms"], 1), *measuring.score_cells(row), *paper))
    heading = (
        "", "Gaussians", "Frame, ms", "PSNR, dB", "SSIM", "ST-LPIPS", "Paper: Gaussians", "Paper: frame, ms",
        "Paper: PSNR, dB",
    )  # fmt: skip
    return Result(
        {"steps": context.options.steps, "rows": rows, "widths": widths},
        ablation_findings(context.options.steps, rows),
        [Table(heading, cells, "Scores are those of the head crop, means over held-out frames.")],
        pictures=measuring.picture_of_runs("ablations", runs, _strongest),
        notes=[
            f"All trainings have the same data, settings, seed and {context.options.steps:,} steps, which shorten all "
            "schedules alike. The paper trains 50,000. No limit holds the number of Gaussians.",
            f"A frame is posed at an expression in which no coefficient is 0 and drawn at {TIMED_SIDE}x{TIMED_SIDE}, "
            "at all threads, one variant after the other, as an avatar that was loaded from its file.",
            *notes,
        ],
    )


def ablation_configs(config: HeadGasConfig) -> dict[str, HeadGasConfig]:
    """The settings of each row, in the paper's order. Without the perceptual loss only if the run has one.

    The limit of the number of Gaussians, which is the run's and not the paper's, is off.
    """
    off = tuple(dict.fromkeys((*config.density.rules_off, "cap")))
    config = replace(config, density=replace(config.density, rules_off=off))
    configs = {name: replace(config, variant=name) for name in get_args(Variant)}
    perceptual = config.photometric.perceptual
    if perceptual.weight > 0:
        without = replace(config.photometric, perceptual=replace(perceptual, weight=0.0))
        configs["no_perceptual"] = replace(config, variant="full", photometric=without)
    return {name: configs[name] for name in ABLATIONS if name in configs}


def widened(context: Context, config: HeadGasConfig, run: Run) -> tuple[Run, dict[int, float]]:
    """Train a run again with layers of twice the width, until the PSNR of the head gains less than `PLATEAU`.

    Returns:
        The last run that gained as much, and the score of each width in dB, or none if nothing was held out.
    """
    best, width, scores = run, config.hidden, {}
    while (score := measuring.held_out_scores(run, None)["head_psnr"]) is not None:
        gained, scores[width] = score - max(scores.values(), default=-math.inf), score
        best = run if gained >= PLATEAU else best
        width *= 2
        if gained < PLATEAU or width > _MOST_WIDTH:
            break
        run = context.train("ablation-no-blending", replace(config, hidden=width))
    return best, scores


def ablation_findings(steps: int, rows: list[dict[str, Any]]) -> list[str]:
    """Say how the rows agree with the paper's claims: the full method has the fewest Gaussians and the best PSNR."""
    few = min(rows, key=lambda row: row["gaussians"])
    findings = [
        f"After {steps:,} steps, {ABLATIONS[few['name']][0]} has the fewest Gaussians "
        f"({few['gaussians']:,}); in the paper it is the full method."
    ]
    scored = {row["name"]: row["head_psnr"] for row in rows if row["head_psnr"] is not None}
    if scored:
        best = max(scored, key=scored.__getitem__)
        findings.append(
            f"{ABLATIONS[best][0].capitalize()} has the best PSNR of the head crop: {scored[best]:.2f} dB, "
            f"against {scored['full']:.2f} dB of the full method, which is the best one in the paper."
        )
    return findings


def _strongest(experiment: Experiment) -> Frame:
    rest = experiment.avatar.subject.expression
    return max(experiment.held_out_frames, key=lambda frame: float((experiment.face(frame).expression - rest).norm()))
