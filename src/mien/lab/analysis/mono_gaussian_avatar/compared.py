"""Short trainings at two resolutions (A.1 of the supplement), and on fewer or less varied frames (A.4)."""

from dataclasses import replace
from math import log
from typing import Any

from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.evaluation.experiment import avatar_image, target_image
from mien.evaluation.metrics import crop_to
from mien.lab.analysis.context import Context, Variant
from mien.lab.analysis.mono_gaussian_avatar.subsets import frontal_quarter, masks, measure, mixed_half, ranges
from mien.lab.analysis.result import PartResult, Picture, Table
from mien.lab.analysis.scoring import METRICS, held_out_scores, perceptual_metric
from mien.lab.analysis.views import labeled
from mien.media.pictures import side_by_side, to_uint8
from mien.perceptual.distance import PerceptualDistance
from mien.training.footage.frames import training_frames

_LEAST = 16
"""Smallest side of training pictures, in pixels."""
GAINS: dict[int, float] = {512: 0.00625, 1024: 0.0025}
"""The paper's largest scale beside the radius of all points, in metres, by the side of its pictures in pixels."""


def resolutions(context: Context) -> PartResult:
    """The same short training with pictures of the run's size and of half of it. Both are scored at full size.

    Each has the paper's bound of scales for the size that is nearest to its own.
    """
    config = context.avatar.config
    assert isinstance(config, MonoGaussianAvatarConfig)
    capture = max(max(one.tracking.cameras[0].width, one.tracking.cameras[0].height) for one in context.sequences)
    full = min(context.settings.resolution or capture, capture)
    sides = [full, max(_LEAST, full // 2)]
    context.say_how_long("resolutions", len(sides))
    trained = {
        f"{side} pixels": context.train(
            f"resolution-{side}", replace(config, scale_gain=scale_gain(side)), resolution=side
        )
        for side in sides
    }
    metric, notes = perceptual_metric()
    rows = [
        {"name": name, "side": side, "scale_gain": scale_gain(side), **_row(context, one, metric)}
        for side, (name, one) in zip(sides, trained.items(), strict=True)
    ]
    cells = tuple((row["side"], 1e3 * row["scale_gain"], *_cells(row)) for row in rows)
    heading = ("Longer side, pixels", "Bound of scales, mm", "Gaussians", "Step, ms", "PSNR, dB", "SSIM", "ST-LPIPS")
    return PartResult(
        {"steps": context.options.steps, "rows": rows},
        _finding(rows),
        (Table(heading, cells, "Scores are those of the head crop at full size, means over held-out frames."),),
        pictures=_pictures(context, "resolutions", trained),
        notes=(
            "The paper trains at 512x512 and at 1024x1024, and gives scales a smaller bound at 1024x1024. Here, each "
            "training has the bound of the nearer of these sizes; all else is as in the run.",
            *notes,
        ),
    )


def scale_gain(side: int) -> float:
    """Return the bound of scales for pictures whose longer side has some pixels, in metres."""
    return GAINS[min(GAINS, key=lambda known: abs(log(known / side)))]


def diversity(context: Context) -> PartResult:
    """The same short training on all frames, on a frontal quarter, and on a half with all poses and expressions."""
    measured = measure(context.sequences, training_frames(context.sequences, context.settings))
    chosen = {
        "all frames": list(range(len(measured.timesteps))),
        "frontal quarter": frontal_quarter(measured),
        "mixed half": mixed_half(measured),
    }
    context.say_how_long("diversity", len(chosen))
    trained, rows, (metric, notes) = {}, [], perceptual_metric()
    for name, some in chosen.items():
        timesteps = masks(context.sequences, measured, some)
        one = context.train(f"diversity-{name.replace(' ', '-')}", context.avatar.config, timesteps=timesteps)
        trained[name] = one
        rows.append({"name": name, "timesteps": len(some), **ranges(measured, some), **_row(context, one, metric)})
    names = ("name", "timesteps", "yaw_range", "pitch_range", "expression_spread")
    cells = tuple((*(row[name] for name in names), *_cells(row)) for row in rows)
    heading = (
        "", "Timesteps", "Yaw, degrees", "Pitch, degrees", "Spread of expressions", "Gaussians", "Step, ms", "PSNR, dB",
        "SSIM", "ST-LPIPS",
    )  # fmt: skip
    return PartResult(
        {"steps": context.options.steps, "rows": rows},
        _finding(rows),
        (Table(heading, cells, "Scores are those of the head crop, means over the same held-out frames."),),
        pictures=_pictures(context, "diversity", trained),
        notes=(
            "The frontal quarter has the views nearest to the median one. Each timestep of the mixed half is the one "
            "that differs most, in tracked pose and expression, from those chosen before it. Ranges of angles are "
            "between the 2nd and the 98th percentile; the spread of expressions is relative to all frames.",
            "All trainings have the same number of steps, so that those on fewer frames see each more often.",
            *notes,
        ),
    )


def _row(context: Context, one: Variant, metric: PerceptualDistance | None) -> dict[str, Any]:
    summary = {name: one.summary[name] for name in ("gaussians", "step_ms_median")}
    return summary | held_out_scores(context.experiment(one.run_dir), metric)


def _cells(row: dict[str, Any]) -> tuple[str | float | int | None, ...]:
    scores = (row[name] if row[name] is None else round(row[name], 2 + (name != "head_psnr")) for name in METRICS)
    return (row["gaussians"], round(row["step_ms_median"], 1), *scores)


def _finding(rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """How far the others are from the first row."""
    scored = [row for row in rows if row["head_psnr"] is not None]
    if len(scored) < len(rows):
        return ("Nothing was held out, so there are no scores; train the run with --split blocks.",)
    first = rows[0]["head_psnr"]
    others = ", ".join(f"{row['name']} {row['head_psnr'] - first:+.2f} dB" for row in rows[1:])
    return (f"PSNR of the head crop: {rows[0]['name']} {first:.2f} dB; compared with it, {others}.",)


def _pictures(context: Context, name: str, trained: dict[str, Variant]) -> tuple[Picture, ...]:
    """A held-out frame in the middle of those: the truth, then each training."""
    tiles = []
    for label, one in trained.items():
        experiment = context.experiment(one.run_dir)
        if experiment is None:
            return ()
        frame = experiment.held_out_frames[len(experiment.held_out_frames) // 2]
        pictures = {"truth": target_image(experiment, frame)} if not tiles else {}
        pictures[label] = avatar_image(experiment, frame)
        box = experiment.crop(frame)
        tiles += [labeled(to_uint8(crop_to(picture, box)), text) for text, picture in pictures.items()]
    return (Picture(name, side_by_side(tiles), "A held-out frame: the truth, then each training."),)
