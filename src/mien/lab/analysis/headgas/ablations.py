"""The ablations, trained alike: Table 1 of the supplement."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch

from mien import _native
from mien.avatar.headgas.settings import HeadGasConfig
from mien.avatar.headgas.settings import Variant as VariantName
from mien.disk.files import file_digest
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import crop_to
from mien.lab.analysis.context import Context, Variant
from mien.lab.analysis.drawing import measure_drawing
from mien.lab.analysis.headgas.trained import busy_face
from mien.lab.analysis.result import PartResult, Picture, Table
from mien.lab.analysis.scoring import METRICS, held_out_scores, perceptual_metric
from mien.lab.analysis.views import labeled
from mien.media.pictures import side_by_side, to_uint8
from mien.perceptual.distance import PerceptualDistance
from mien.training.footage.frames import Frame

PAPER: dict[str, tuple[str, int | None, float | None, float]] = {
    "no_blending": ("without blending", 135_000, 8.0, 29.38),
    "change_all": ("change all", 97_000, 12.0, 29.65),
    "delta": ("with delta(mu, R)", 234_000, 19.0, 29.83),
    "no_mlp": ("without the network", 295_000, 10.0, 32.08),
    "no_perceptual": ("without the perceptual loss", None, None, 32.11),
    "full": ("full", 28_000, 4.0, 32.50),
}
"""Variant -> its name, and Gaussians, milliseconds of a frame and PSNR in the paper, in the order of its Table 1."""
SIZE = 512
"""Side of the pictures that are timed."""


def ablations(context: Context) -> PartResult:
    """The same short training for each variant: Gaussians, time of a frame, and scores of held-out frames."""
    config = context.avatar.config
    assert isinstance(config, HeadGasConfig)
    configs = ablation_configs(config)
    context.say_how_long("ablations", len(configs))
    trained = {name: context.train(f"ablation-{name.replace('_', '-')}", one) for name, one in configs.items()}
    metric, notes = perceptual_metric()
    rows = [_row(context, name, one, metric) for name, one in trained.items()]
    if "no_perceptual" not in configs:
        notes.append(
            "This run has no perceptual loss, so there is no row without it; train the run with "
            "--method.photometric.perceptual.weight above 0 to compare."
        )
    cells = tuple(_cells(row) for row in rows)
    heading = (
        "", "Gaussians", "Frame, ms", "PSNR, dB", "SSIM", "ST-LPIPS", "Paper: Gaussians", "Paper: frame, ms",
        "Paper: PSNR, dB",
    )  # fmt: skip
    return PartResult(
        {"steps": context.options.steps, "rows": rows},
        findings(config, context.options.steps, rows),
        (Table(heading, cells, "Scores are those of the head crop, means over held-out frames."),),
        pictures=_picture(context, trained),
        notes=(
            f"All trainings have the same data, settings, seed and {context.options.steps:,} steps, which shorten all "
            "schedules alike. The paper trains 50,000.",
            f"A frame is posed at an expression in which no coefficient is 0 and drawn at {SIZE}x{SIZE}, at all "
            "threads, one variant after the other.",
            *notes,
        ),
    )


def ablation_configs(config: HeadGasConfig) -> dict[str, HeadGasConfig]:
    """The settings of each row, in the paper's order. Without the perceptual loss only if the run has one."""
    perceptual = config.photometric.perceptual
    known: tuple[VariantName, ...] = get_args(VariantName)
    configs = {name: replace(config, variant=name) for name in known}
    if perceptual.weight > 0:
        without = replace(config.photometric, perceptual=replace(perceptual, weight=0.0))
        configs["no_perceptual"] = replace(config, variant="full", photometric=without)
    return {name: configs[name] for name in PAPER if name in configs}


def _row(context: Context, name: str, variant: Variant, metric: PerceptualDistance | None) -> dict[str, Any]:
    camera, face = context.camera.fitted(SIZE, SIZE), busy_face(context)
    digest = file_digest(variant.run_dir / "avatar" / "avatar.safetensors")
    drawn = context.kept(
        f"ablation-{name.replace('_', '-')}",
        [digest, context.options.seconds, _native.thread_count()],
        lambda: measure_drawing(variant.avatar, camera, context.options.seconds, face),
    )
    row = {
        "name": name,
        "gaussians": variant.summary["gaussians"],
        "frame_ms": round(drawn["draw_ms"] + drawn["pose_ms"], 2),
    }
    return row | held_out_scores(context.experiment(variant.run_dir), metric)


def _cells(row: dict[str, Any]) -> tuple[str | float | int | None, ...]:
    label, gaussians, milliseconds, psnr = PAPER[row["name"]]
    scores = (row[name] if row[name] is None else round(row[name], 2 + (name != "head_psnr")) for name in METRICS)
    return (label, row["gaussians"], round(row["frame_ms"], 1), *scores, gaussians, milliseconds, psnr)


def findings(config: HeadGasConfig, steps: int, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """What the rows say about the paper's claims: the full method has the fewest Gaussians and the best PSNR."""
    counts = [row["gaussians"] for row in rows]
    if len(set(counts)) == 1:
        found = [f"All variants have {counts[0]:,} Gaussians; in the paper, the full method has the fewest."]
    else:
        few = min(rows, key=lambda row: row["gaussians"])
        found = [
            f"After {steps:,} steps, {PAPER[few['name']][0]} has the fewest Gaussians "
            f"({few['gaussians']:,}); in the paper it is the full method."
        ]
    if max(counts) >= config.density.max_gaussians:
        found.append(
            f"The limit of {config.density.max_gaussians:,} Gaussians was reached, so counts say little; "
            "analyze a run with a larger --method.density.max-gaussians to compare them."
        )
    scored = [row for row in rows if row["head_psnr"] is not None]
    if scored:
        best = max(scored, key=lambda row: row["head_psnr"])
        full = next(row for row in rows if row["name"] == "full")
        found.append(
            f"{PAPER[best['name']][0].capitalize()} has the best PSNR of the head crop: {best['head_psnr']:.2f} dB, "
            f"against {full['head_psnr']:.2f} dB of the full method, which is the best one in the paper."
        )
    return tuple(found)


def _picture(context: Context, trained: dict[str, Variant]) -> tuple[Picture, ...]:
    """The held-out frame with the strongest expression: the truth, then each variant."""
    experiments = {name: context.experiment(one.run_dir) for name, one in trained.items()}
    first = experiments["full"]
    if first is None:
        return ()
    frame = _strongest(first)
    tiles = [labeled(_head(first, frame, None), "truth")]
    for name, experiment in experiments.items():
        assert experiment is not None
        tiles.append(labeled(_head(experiment, frame, avatar_image(experiment, frame)), name))
    sequence = first.sequences[frame.sequence].name
    caption = f"{sequence}, timestep {frame.timestep}, held out: the truth, and each variant."
    return (Picture("ablations", side_by_side(tiles), caption),)


def _strongest(experiment: Experiment) -> Frame:
    rest = experiment.avatar.subject.expression
    return max(
        experiment.held_out_frames,
        key=lambda frame: float((experiment.face(frame).expression - rest).norm()),
    )


def _head(experiment: Experiment, frame: Frame, image: torch.Tensor | None) -> np.ndarray:
    shown = target_image(experiment, frame) if image is None else image
    return to_uint8(crop_to(shown, experiment.crop(frame)))
