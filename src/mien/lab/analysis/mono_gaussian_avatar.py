"""The analysis of MonoGaussianAvatar (Chen et al., SIGGRAPH 2024): experiments of the paper and of its supplement."""

from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.mono_gaussian_avatar.settings import MonoGaussianAvatarConfig
from mien.avatar.settings import Progress
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, target_image
from mien.evaluation.metrics import psnr
from mien.lab.analysis import measuring
from mien.lab.analysis.result import Chart, Picture, Result, Table
from mien.lab.analysis.running import Context, Run
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.media.pictures import side_by_side
from mien.pages.pages import Axes, Series
from mien.perceptual.distance import PerceptualDistance
from mien.render import rasterize
from mien.runtime.filmed import head_angles
from mien.training.footage.frames import Frame, camera_extent, spread_frames, training_frames
from mien.training.footage.sequence import Sequence
from mien.training.trainer import train

_TABLE_4 = {
    "NeRFace": (48.0, 2000.0),
    "IMavatar": (54.0, 38_000.0),
    "PointAvatar": (11.0, 50.0),
    "MonoGaussianAvatar": (9.0, 30.0),
}
"""Hours of training and milliseconds of a frame on one GPU, in the paper."""
SIDE = 512
"""Side of the pictures that are timed."""
GAINS: dict[int, float] = {512: 0.00625, 1024: 0.0025}
"""The paper's largest scale beside the radius of all points, in metres, by the side of its pictures in pixels."""


def times(context: Context) -> Result:
    """Minutes of this run's training, and milliseconds of a frame with the networks and with the baked avatar."""
    machine, avatar = format_machine(measure_machine(gpu=context.like.is_cuda)), context.timed_avatar
    rows: dict[str, dict[str, float | int]] = {}
    for name, training in (("networks", True), ("baked", False)):
        avatar.train(training)
        rows[name] = measuring.measure_drawing(avatar, context.camera.fitted(SIDE, SIDE), context.options.seconds)
    frames = {name: round(row["draw_ms"] + row["pose_ms"], 3) for name, row in rows.items()}
    hours, count = context.summary["seconds"] / 3600, len(avatar.store)
    cells: list[tuple[str | float | None, ...]] = [
        (f"this run, {name}", round(hours, 3), *(round(ms, 1) for ms in (frames[name], row["pose_ms"], row["draw_ms"])))
        for name, row in rows.items()
    ]
    cells += [(f"paper: {name}", hour, frame, None, None) for name, (hour, frame) in _TABLE_4.items()]
    return Result(
        {
            "machine": machine,
            "threads": rows["baked"]["threads"],
            "gaussians": count,
            "training_hours": round(hours, 4),
            "frame_ms": frames,
            "rows": rows,
        },
        [
            f"{count:,} Gaussians, {measuring.measured_on(rows['baked'])}: training took {60 * hours:.1f} min, and a "
            f"frame of the baked avatar takes {frames['baked']:.1f} ms at {SIDE}x{SIDE} (paper, on a GPU: 9 h and "
            "30 ms)."
        ],
        [Table(("", "Training, h", "Frame, ms", "Posing, ms", "Drawing, ms"), cells, machine)],
        notes=[
            "A frame is the person at rest, posed and drawn from the camera of training over white. Times are medians.",
            "`mien evaluate`, `mien render` and `mien drive` pose the baked avatar; training runs the networks.",
        ],
    )


def convergence(context: Context) -> Result:
    """Train once more for `options.steps` steps, and draw held-out frames at several times: Fig. 13."""
    experiment = context.experiment
    if experiment is None:
        raise UserError(
            f"{context.run_dir}: nothing was held out, so there is no picture to compare; train it with --split blocks"
        )
    context.say_how_long("convergence", 1)
    frames = spread_frames(experiment.held_out_frames, 8)
    targets = [target_image(experiment, frame) for frame in frames]
    steps = sorted({max(1, round(share * context.options.steps)) for share in (0.02, 0.05, 0.1, 0.25, 0.5, 1.0)})
    rows, tiles = [], [measuring.labeled(measuring.head_picture(experiment, frames[0], targets[0]), "truth")]
    for reached, gaussians, pictures in _snapshots(context, experiment, frames, steps):
        drawn_and_true = zip(pictures, targets, frames, strict=True)
        scores = [psnr(picture, target, experiment.crop(frame)) for picture, target, frame in drawn_and_true]
        rows.append({"step": reached, "gaussians": gaussians, "head_psnr": round(float(np.mean(scores)), 3)})
        tiles.append(measuring.labeled(measuring.head_picture(experiment, frames[0], pictures[0]), f"step {reached}"))
    x, y, counts = (np.array([row[name] for row in rows], float) for name in ("step", "head_psnr", "gaussians"))
    near = next(row["step"] for row in rows if row["head_psnr"] >= max(y) - 1)
    points = Axes("step", "points", from_zero=True)
    return Result(
        {"steps": context.options.steps, "rows": rows},
        [
            f"The head crop has {y[-1]:.1f} dB after {int(x[-1]):,} steps. It comes within 1 dB of its best value by "
            f"step {near:,}."
        ],
        [Table(("Step", "Gaussians", "PSNR of the head, dB"), [tuple(row.values()) for row in rows])],
        [
            Chart("convergence-psnr", "Fig. 13: PSNR of the head", [Series("this run", x, y)], Axes("step", "dB")),
            Chart("convergence-points", "Number of points", [Series("this run", x, counts)], points),
        ],
        [Picture("convergence", side_by_side(tiles), "A held-out frame: the truth, then the avatar as it learns.")],
        notes=[
            "This training has the run's data, settings and seed, with all schedules shortened to its steps. Faces of "
            "held-out frames are those of the tracker. A stopped training of this part starts again."
        ],
    )


def _snapshots(
    context: Context, experiment: Experiment, frames: list[Frame], steps: list[int]
) -> list[tuple[int, int, list[Tensor]]]:
    """Step, number of Gaussians and pictures of `frames` at each of some steps, from one training."""
    settings, sequences = context.short_settings, context.sequences
    trained = training_frames(sequences, settings)
    extent = camera_extent(sequences, trained)
    snapshots: list[tuple[int, int, list[Tensor]]] = []
    done = 0

    def watch(avatar: Avatar) -> None:
        nonlocal done
        taken = max(1, min(avatar.extras.frames_per_step(done / settings.steps), settings.steps - done))
        progress = Progress(done, settings.steps, done // len(trained), extent, taken)
        done += taken
        if progress.completes(steps):
            pictures = [drawn(avatar, experiment, frame, progress) for frame in frames]
            snapshots.append((done, len(avatar.store), pictures))

    with TemporaryDirectory(prefix="mien-analysis-") as folder:
        train(sequences, context.avatar.face_model, context.avatar.config, settings, Path(folder) / "run", watch=watch)
    return snapshots


@torch.no_grad()
def drawn(avatar: Avatar, experiment: Experiment, frame: Frame, progress: Progress) -> Tensor:
    """The avatar's picture of a frame, at this point of its training."""
    face, like = experiment.sequences[frame.sequence].tracking.face[frame.timestep], avatar.face_model.template
    gaussians = avatar.pose(face.to(like), progress).gaussians.timestep(0)
    return rasterize(gaussians, experiment.camera(frame).to(like), like.new_ones(3)).image.cpu().float()


def resolutions(context: Context) -> Result:
    """The same short training with pictures of 1024 and of 512 pixels, both scored at the capture's size: A.1.

    Each has the paper's bound of scales for the size that is nearest to its own. A smaller capture is trained at its
    own size and at half of it.
    """
    config = context.avatar.config
    assert isinstance(config, MonoGaussianAvatarConfig)
    capture = max(max(one.tracking.cameras[0].width, one.tracking.cameras[0].height) for one in context.sequences)
    full = min(context.settings.resolution or capture, capture)
    context.say_how_long("resolutions", 2)
    runs, rows, (metric, notes) = {}, [], measuring.perceptual_metric()
    small = full < max(GAINS)
    for side in (full, max(16, full // 2)) if small else (max(GAINS), min(GAINS)):
        name, gain = f"{side} pixels", scale_gain(side)
        runs[name] = context.train(f"resolution-{side}", replace(config, scale_gain=gain), resolution=side)
        rows.append({"name": name, "side": side, "scale_gain": gain, **_scored(runs[name], metric)})
    cells = [(row["side"], 1e3 * row["scale_gain"], *_cells(row)) for row in rows]
    heading = ("Longer side, pixels", "Bound of scales, mm", "Gaussians", "Step, ms", "PSNR, dB", "SSIM", "ST-LPIPS")
    return Result(
        {"steps": context.options.steps, "rows": rows},
        [_finding(rows)],
        [Table(heading, cells, "Scores are those of the head crop at full size, means over held-out frames.")],
        pictures=measuring.picture_of_runs("resolutions", runs, _middle),
        notes=[
            "The paper trains at 512x512 and at 1024x1024, and gives scales a smaller bound at 1024x1024. Here, each "
            "training has the bound of the nearer of these sizes; all else is as in the run, which has the paper's "
            "settings if it was trained with --preset paper or paper-cpu.",
            *([f"The pictures have {full} pixels; --capture.size 1024 gives more, if the video has them."] * small),
            *notes,
        ],
    )


def scale_gain(side: int) -> float:
    """Return the bound of scales for pictures whose longer side has some pixels, in metres."""
    return GAINS[min(GAINS, key=lambda known: abs(log(known / side)))]


def diversity(context: Context) -> Result:
    """The same short training on all frames, on two clips by time as in the paper, and on two choices by pose: A.4."""
    measured = measure(context.sequences, training_frames(context.sequences, context.settings))
    subsets = {
        "all frames": list(range(len(measured.timesteps))), "frontal clip": clip(measured, 0.25, mixed=False),
        "mixed clip": clip(measured, 0.5, mixed=True), "frontal quarter": frontal_quarter(measured),
        "mixed half": mixed_half(measured),
    }  # fmt: skip
    context.say_how_long("diversity", len(subsets))
    runs, rows, (metric, notes) = {}, [], measuring.perceptual_metric()
    for name, chosen in subsets.items():
        timesteps = masks(context.sequences, measured, chosen)
        runs[name] = context.train(f"diversity-{name.replace(' ', '-')}", context.avatar.config, timesteps=timesteps)
        of_subset = {"name": name, "timesteps": len(chosen), **ranges(measured, chosen)}
        rows.append({**of_subset, **_scored(runs[name], metric)})
    names = ("name", "timesteps", "yaw_range", "pitch_range", "expression_spread")
    cells = [(*(row[name] for name in names), *_cells(row)) for row in rows]
    heading = (
        "", "Timesteps", "Yaw, degrees", "Pitch, degrees", "Spread of expressions", "Gaussians", "Step, ms", "PSNR, dB",
        "SSIM", "ST-LPIPS",
    )  # fmt: skip
    return Result(
        {"steps": context.options.steps, "rows": rows},
        [_finding(rows)],
        [Table(heading, cells, "Scores are those of the head crop, means over the same held-out frames.")],
        pictures=measuring.picture_of_runs("diversity", runs, _middle),
        notes=[
            "The paper has a frontal clip of 30 s and a mixed one of 60 s, of 120 s. Here, they are successive "
            "timesteps, a quarter and half of all: with the views nearest to the median one, and with the most varied.",
            "The frontal quarter has the single views nearest to the median one. Each timestep of the mixed half is "
            "the one that differs most, in tracked pose and expression, from those chosen before it. Ranges of angles "
            "are between the 2nd and the 98th percentile; the spread of expressions is relative to all frames.",
            "All trainings have the same number of steps, so that those on fewer frames see each more often.",
            *notes,
        ],
    )


def _scored(run: Run, metric: PerceptualDistance | None) -> dict[str, Any]:
    return {name: run.summary[name] for name in ("gaussians", "step_ms_median")} | measuring.held_out_scores(
        run, metric
    )


def _cells(row: dict[str, Any]) -> tuple[float | int | None, ...]:
    return (row["gaussians"], round(row["step_ms_median"], 1), *measuring.score_cells(row))


def _finding(rows: list[dict[str, Any]]) -> str:
    """How far the others are from the first row."""
    if any(row["head_psnr"] is None for row in rows):
        return "Nothing was held out, so there are no scores; train the run with --split blocks."
    first = rows[0]["head_psnr"]
    others = ", ".join(f"{row['name']} {row['head_psnr'] - first:+.2f} dB" for row in rows[1:])
    return f"PSNR of the head crop: {rows[0]['name']} {first:.2f} dB; compared with it, {others}."


def _middle(experiment: Experiment) -> Frame:
    return experiment.held_out_frames[len(experiment.held_out_frames) // 2]


@dataclass(frozen=True, eq=False)
class Measured:
    """Pose and expression of the n timesteps that a run trains on."""

    timesteps: tuple[tuple[int, int], ...]
    """Sequence and timestep of each."""
    angles: Float[np.ndarray, "n 2"]
    """Yaw and pitch of the first camera as the head sees it, in radians."""
    expressions: Float[np.ndarray, "n e"]
    """Expression coefficients, each divided by its standard deviation over all timesteps."""


def measure(sequences: list[Sequence], frames: list[Frame]) -> Measured:
    """Pose and expression of the timesteps of some frames."""
    timesteps = sorted({(frame.sequence, frame.timestep) for frame in frames})
    angles, expressions = [], []
    for sequence, timestep in timesteps:
        tracking = sequences[sequence].tracking
        face = tracking.face[timestep]
        position = tracking.cameras[0].position.numpy()
        angles.append(head_angles(face.head_rotation.numpy(), face.head_translation.numpy(), position)[0, :2])
        expressions.append(face.expression[0].numpy())
    values = np.array(expressions, np.float64)
    return Measured(tuple(timesteps), np.array(angles, np.float64), values / np.maximum(values.std(0), 1e-6))


def frontal_quarter(measured: Measured) -> list[int]:
    """The quarter of the timesteps whose view is nearest to the median one, in the order of time."""
    distance = _from_the_front(measured)
    count = max(1, round(0.25 * len(distance)))
    return sorted(np.argsort(distance, kind="stable")[:count].tolist())


def clip(measured: Measured, share: float, *, mixed: bool) -> list[int]:
    """Successive timesteps, `share` of all: those with the views nearest to the median one, or with the most varied."""
    distance = _from_the_front(measured)
    count = max(1, round(share * len(distance)))

    def worth(first: int) -> float:
        part = slice(first, first + count)
        return float(measured.angles[part].std(0).sum() if mixed else -distance[part].mean())

    first = max(range(len(distance) - count + 1), key=worth)
    return list(range(first, first + count))


def _from_the_front(measured: Measured) -> Float[np.ndarray, " n"]:
    return np.linalg.norm(measured.angles - np.median(measured.angles, axis=0), axis=1)


def mixed_half(measured: Measured) -> list[int]:
    """Half of the timesteps that keeps the range of poses and expressions, in the order of time.

    Each next timestep is the one that is farthest from all that were chosen before. Pose and expression count alike.
    """
    spread = np.maximum(measured.angles.std(0), 1e-6)
    angles = (measured.angles - measured.angles.mean(0)) / spread / np.sqrt(measured.angles.shape[1])
    features = np.concatenate([angles, measured.expressions / np.sqrt(measured.expressions.shape[1])], axis=1)
    chosen = [int(np.linalg.norm(features - features.mean(0), axis=1).argmin())]
    nearest = np.full(len(features), np.inf)
    for _ in range(max(1, round(0.5 * len(features))) - 1):
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return sorted(chosen)


def ranges(measured: Measured, chosen: list[int]) -> dict[str, float]:
    """Range of yaw and pitch between their 2nd and 98th percentiles, in degrees, and the mean spread of expressions.

    The spread is 1 for all timesteps together.
    """
    low, high = np.percentile(np.degrees(measured.angles[chosen]), (2, 98), axis=0)
    moving = measured.expressions.std(0) > 0.5
    spread = measured.expressions[chosen][:, moving].std(0).mean() if moving.any() else 0.0
    return {
        "yaw_range": round(float(high[0] - low[0]), 2),
        "pitch_range": round(float(high[1] - low[1]), 2),
        "expression_spread": round(float(spread), 3),
    }


def masks(sequences: list[Sequence], measured: Measured, chosen: list[int]) -> list[Bool[Tensor, " t"]]:
    """The chosen timesteps as a mask for each sequence."""
    kept = [torch.zeros(len(one.tracking.face), dtype=torch.bool) for one in sequences]
    for index in chosen:
        sequence, timestep = measured.timesteps[index]
        kept[sequence][timestep] = True
    return kept
