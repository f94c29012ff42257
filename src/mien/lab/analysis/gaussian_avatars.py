"""The analysis of GaussianAvatars (Qian et al., CVPR 2024): the figures and tables of the paper's supplement."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.gaussian_avatars.settings import GaussianAvatarsConfig
from mien.errors import UserError
from mien.evaluation.experiment import Experiment, avatar_image, target_image
from mien.evaluation.metrics import crop_to, psnr
from mien.face.loading import without_teeth
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.analysis import measuring
from mien.lab.analysis.measuring import draw_avatar, mean_psnr, measured_on, mouth_box, mouth_camera
from mien.lab.analysis.result import Chart, Picture, Result, Table
from mien.lab.analysis.running import Context, Run
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.machine.progress import track_progress
from mien.media.pictures import side_by_side, to_uint8
from mien.pages.pages import Axes, Series
from mien.render import rasterize
from mien.training.footage.frames import Frame, spread_frames

_PAPER_START, _PAPER_END = 10_144, 100_000
"""The supplement, section C: one Gaussian for each triangle at first, and about so many at the end, on average."""
_NEAR = 0.05
"""Share by which a number of Gaussians may differ from the first or the largest one to count as that one."""
TABLE_3 = {(225, 401): 187, (550, 802): 187, (1100, 1604): 156, (2200, 3208): 95, (4400, 6416): 36}
"""Width and height in pixels (the paper writes height x width) -> frames per second, for subject 306."""
_SIDE = 360
"""Width and height of a picture of a mouth, in pixels."""
_NO_TEETH = "The face model of this run has no triangles of teeth, so there is nothing to compare."


def growth(context: Context) -> Result:
    """How the number of Gaussians and the time of a step grow over the run, from its curves: Fig. 3."""
    config = context.avatar.config
    assert isinstance(config, GaussianAvatarsConfig)
    curves = np.stack([context.curves[name] for name in ("step", "gaussians", "step_ms")])
    steps, gaussians, times = curves[:, np.isfinite(curves).all(0)]
    if not len(steps):
        raise UserError(f"{context.run_dir}: its curves have no entry that is whole; train it again")
    start, peak = float(gaussians[0]), float(gaussians.max())
    at_peak = times[gaussians >= peak * (1 - _NEAR)]
    few, many = (float(np.median(part)) for part in (times[gaussians <= start * (1 + _NEAR)], at_peak))
    grown, slower = peak / max(start, 1), many / max(few, 1e-9)
    memory, gpu = context.summary["peak_memory_mb"], context.summary.get("gpu_memory_mb")
    values = {
        "gaussians_start": int(start), "gaussians_peak": int(peak), "gaussians_growth": round(grown, 3),
        "step_ms_start": round(few, 3), "step_ms_peak": round(many, 3), "step_time_growth": round(slower, 3),
        "training_peak_memory_mb": memory, "training_gpu_memory_mb": gpu,
        "paper": {"gaussians_start": _PAPER_START, "gaussians_end": _PAPER_END, "step_time_growth_at_most": 2.0},
    }  # fmt: skip
    rows = (
        ("Gaussians at the start", int(start), _PAPER_START),
        ("Gaussians, most", int(peak), _PAPER_END),
        ("Gaussians grow, times", round(grown, 1), 10),
        ("Step, with Gaussians as at the start, ms", round(few, 1), None),
        ("Step, with the most Gaussians, ms", round(many, 1), None),
        ("Step time grows, times", round(slower, 2), "at most 2"),
        ("Memory of the GPU in training, most, MB", gpu and round(gpu), "fits 12 GB"),
        ("Memory of the host in training, most, MB", round(memory), None),
    )
    finding = (
        f"Step time grows {slower:.1f} times while Gaussians grow {grown:.1f} times. In the paper it at most doubles "
        "while Gaussians grow about 10 times."
    )
    notes = [
        "Step times are medians: over the steps with at most 5 % more Gaussians than at the start, and over those with "
        "at least 95 % of the most. Other work on the machine during training changes them.",
        "The paper's figures are those of section C of its supplement, for 600,000 steps on a GPU.",
        "Memory of the GPU is that of all tensors on it; a training on a CPU has none. That of the host is of the "
        "whole process, libraries and pictures included.",
        *_doubts(at_peak, peak, config.density.max_gaussians),
    ]
    charts = _growth_charts(steps, gaussians, times, few)
    return Result(values, [finding], [Table(("", "This run", "Paper"), rows)], charts, notes=notes)


def _doubts(at_peak: np.ndarray, peak: float, limit: int) -> list[str]:
    """Notes if other work disturbed the steps with the most Gaussians, or if the run's limit ended the growth."""
    notes = []
    low, high = np.percentile(at_peak, (25, 75))
    if high > 1.3 * low:
        notes.append(
            f"The middle half of the steps with the most Gaussians takes {low:.1f} to {high:.1f} ms, so other work "
            "probably ran beside the training, and the growth of the step time is uncertain."
        )
    if peak >= limit * (1 - _NEAR):
        notes.append(f"The number of Gaussians ends at this run's limit, --method.density.max-gaussians {limit:,}.")
    return notes


def _growth_charts(steps: np.ndarray, gaussians: np.ndarray, times: np.ndarray, few: float) -> list[Chart]:
    """The curves; `few` is the time of a step at the start in milliseconds."""
    ends = np.array([steps[0], steps[-1]])
    number = [
        Series("this run", steps, gaussians),
        Series("paper, at the start", ends, np.full(2, float(_PAPER_START)), "quiet"),
        Series("paper, at the end", ends, np.full(2, float(_PAPER_END)), "second"),
    ]
    # A few late steps would flatten the rest.
    single = np.minimum(times, np.percentile(times, 99))
    windows = [part for part in np.array_split(np.arange(len(steps)), 60) if len(part)]
    middle = Series(
        "median",
        np.array([steps[part].mean() for part in windows]),
        np.array([np.median(times[part]) for part in windows]),
    )
    most = Series("paper: at most", ends, np.full(2, 2 * few), "second")
    return [
        Chart("growth-gaussians", "Fig. 3a: number of Gaussians", number, Axes("step", "Gaussians", from_zero=True)),
        Chart(
            "growth-step-time",
            "Fig. 3b: time of a step, ms",
            [Series("single steps", steps, single, "quiet"), middle, most],
            Axes("step", "ms", from_zero=True),
        ),
    ]


def speed(context: Context) -> Result:
    """Frames per second, at all threads, and memory at the five sizes of Table 3."""
    seconds, machine = context.options.seconds, format_machine(measure_machine(gpu=context.like.is_cuda))
    rows: list[dict[str, Any]] = []
    for size in track_progress(list(TABLE_3), "speed", len(TABLE_3)):
        row = measuring.measure_drawing(context.timed_avatar, context.camera.fitted(*size), seconds)
        fps = round(1e3 / max(row["draw_ms"] + row["pose_ms"], 1e-6), 2)
        rows.append({**row, "fps": fps, "paper_fps": TABLE_3[size]})
    cells = [
        (
            f"{row['width']}x{row['height']}", row["fps"], row["paper_fps"], round(row["draw_ms"], 1),
            round(row["pose_ms"], 1), row["pictures"], round(row["peak_mb"] - row["before_mb"]), round(row["peak_mb"]),
        )
        for row in rows
    ]  # fmt: skip
    columns = (
        "Width x height", "Frames/s", "Paper", "Drawing, ms", "Posing, ms", "Pictures timed", "Memory added, MB",
        "Memory in all, MB",
    )  # fmt: skip
    count, threads, second, place = len(context.avatar.store), rows[0]["threads"], rows[1], measured_on(rows[1])
    slower = rows[0]["fps"] / max(rows[-1]["fps"], 1e-6)
    pixels = np.array([row["width"] * row["height"] for row in rows]) / 1e6
    ours, paper = (np.array([row[name] for row in rows], np.float64) for name in ("fps", "paper_fps"))
    with torch.no_grad():
        gaussians = context.avatar.pose(context.avatar.subject).gaussians.timestep(0)
        image = rasterize(gaussians, context.camera.fitted(550, 802), torch.ones(3)).image
    return Result(
        {"machine": machine, "gaussians": count, "threads": threads, "rows": rows},
        [
            f"{count:,} Gaussians at 550x802, with {place}: {second['fps']:.1f} "
            f"frames/s; the paper reports {second['paper_fps']} on a GPU. From 225x401 to 4400x6416, pixels grow 313 "
            f"times and a frame takes {slower:.0f} times as long (paper: {187 / 36:.1f} times)."
        ],
        [Table(columns, cells, machine)],
        [
            Chart(
                "speed",
                "Table 3: frames per second over the size of the picture",
                [Series(f"this run, {place}", pixels, ours), Series("paper, a GPU", pixels, paper, "second")],
                Axes("megapixels, from 225x401 to 4400x6416", "frames/s", logarithmic=True),
                "Both axes are logarithmic.",
            )
        ],
        [Picture("speed-picture", to_uint8(image), "What is drawn, at 550x802.")],
        notes=[
            "A frame is posed and drawn from the camera of training, fitted into the picture, over white. Times are "
            f"medians; each row took about {seconds:g} s.",
            "The paper does not name the GPU of Table 3. Its model has about 100,000 Gaussians.",
            "Memory added is the largest while drawing, less that before: of the process, or of the tensors on a GPU.",
        ],
    )


def teeth(context: Context) -> Result:
    """The avatar with an open jaw, with and without the Gaussians that are bound to triangles of teeth: Fig. 1."""
    avatar, model = context.avatar, context.avatar.face_model
    of_teeth = model.region_mask("teeth")
    if not bool(of_teeth.any()):
        return Result({"teeth_triangles": 0}, [_NO_TEETH])
    kept = ~of_teeth[avatar.store["face_index"].long()]
    count, triangles = int((~kept).sum()), int(of_teeth.sum())
    face = open_jaw(avatar.subject, model)
    camera = mouth_camera(model, face, context.camera, _SIDE)
    drawn = [
        draw_avatar(avatar, face, context.camera.fitted(_SIDE, _SIDE)),
        draw_avatar(avatar, face, camera),
        draw_avatar(avatar, face, camera, kept),
    ]
    caption = "The avatar with an open jaw; its mouth; and its mouth without the Gaussians on the teeth's triangles."
    pictures = [Picture("teeth", side_by_side(drawn), caption)]
    values: dict[str, Any] = {"teeth_triangles": triangles, "teeth_gaussians": count, "gaussians": len(kept)}
    findings = [f"{count:,} of {len(kept):,} Gaussians are bound to the {triangles:,} triangles of teeth."]
    notes = [
        "Taking Gaussians away from a trained avatar overstates what teeth give, because the others were trained "
        "beside them. The part teeth-trained trains both.",
    ]
    try:
        experiment = context.experiment
    except UserError as error:
        experiment = None
        notes.append(f"No frames were compared: {error}.")
    if experiment is not None:
        frames = _most_open(experiment)
        with_teeth, without = (_mouth_psnr(experiment, frames, model, mask) for mask in (None, kept))
        values |= {"mouth_psnr_with": with_teeth, "mouth_psnr_without": without, "frames": len(frames)}
        findings.append(
            f"On the mouths of the {len(frames)} held-out frames with the most open jaw, PSNR is {with_teeth:.2f} dB "
            f"with them and {without:.2f} dB without."
        )
        pictures += [_beside_truth(experiment, frame, kept, i) for i, frame in enumerate(frames[:3])]
    return Result(values, findings, pictures=pictures, notes=notes)


def teeth_trained(context: Context) -> Result:
    """The same short training with and without the triangles of teeth: Fig. 1."""
    model, config = context.avatar.face_model, context.avatar.config
    if not bool(model.region_mask("teeth").any()):
        return Result({"teeth_triangles": 0}, [_NO_TEETH])
    context.say_how_long("teeth-trained", 2)
    runs = [context.train("teeth-on", config), context.train("teeth-off", config, without_teeth(model))]
    rows = []
    for name, run in zip(("with teeth", "without teeth"), runs, strict=True):
        mouth = head = None
        if (experiment := run.experiment) is not None:
            frames = _most_open(experiment)
            mouth = round(_mouth_psnr(experiment, frames, model), 2)
            head = round(mean_psnr(experiment, frames), 2)
        rows.append((name, run.summary["gaussians"], mouth, head))
    camera = mouth_camera(model, face := open_jaw(context.avatar.subject, model), context.camera, _SIDE)
    drawn = [draw_avatar(run.avatar, face, camera) for run in runs]
    names = ("name", "gaussians", "mouth_psnr", "head_psnr")
    findings = [
        f"After {context.options.steps:,} steps, PSNR on the mouths of the held-out frames with the most open jaw "
        f"is {first[2]:.2f} dB with the teeth's triangles and {second[2]:.2f} dB without."
        for first, second in pairwise(rows)
        if first[2] is not None
    ]
    return Result(
        {"steps": context.options.steps, "rows": [dict(zip(names, row, strict=True)) for row in rows]},
        findings,
        [Table(("", "Gaussians", "PSNR of the mouth, dB", "PSNR of the head crop, dB"), rows)],
        pictures=[Picture("teeth-trained", side_by_side(drawn), "Trained with the teeth's triangles, and without.")],
        notes=[
            "Both trainings have the same settings, seed and frames.",
            f"{context.options.steps:,} steps are a short training; all schedules are shortened with it.",
        ],
    )


def open_jaw(face: FaceParams, model: FaceModel) -> FaceParams:
    """The face with an open jaw: 0.3 radians by the joint, if it is free, or 0.7 of the expression that turns it most.

    A face model without a jaw gives the face unchanged.
    """
    if "jaw" not in model.joint_names:
        return face
    if "jaw" in model.free_joint_names:
        joints = face.joints.clone()
        joints[:, model.free_joint_names.index("jaw"), 0] = 0.3
        return replace(face, joints=joints)
    strongest = _jaw_expression(model)
    expression = face.expression.clone()
    expression[:, strongest] = 0.7 * model.expression_bounds[strongest, 1]
    return replace(face, expression=expression)


def jaw_opening(face: FaceParams, model: FaceModel) -> Float[Tensor, " b"]:
    """How far the jaw is open at each timestep, in the units of its joint or expression."""
    if "jaw" in model.free_joint_names:
        return face.joints[:, model.free_joint_names.index("jaw"), 0]
    return face.expression[:, _jaw_expression(model)]


def _jaw_expression(model: FaceModel) -> int:
    return int(model.joint_rotation_basis[:, model.joint_names.index("jaw")].norm(dim=-1).argmax())


def _most_open(experiment: Experiment) -> list[Frame]:
    """The 12 held-out frames with the most open jaw, widest first, at most one per timestep."""
    model = experiment.avatar.face_model
    by_time = {(frame.sequence, frame.timestep): frame for frame in reversed(experiment.held_out_frames)}
    openings = {key: float(jaw_opening(experiment.face(frame), model)[0]) for key, frame in by_time.items()}
    return [by_time[key] for key in sorted(openings, key=lambda key: (-openings[key], key))[:12]]


@torch.no_grad()
def _image(experiment: Experiment, frame: Frame, kept: Bool[Tensor, " n"] | None) -> Tensor:
    if kept is None:
        return avatar_image(experiment, frame)
    gaussians = experiment.avatar.pose(experiment.face(frame)).gaussians.timestep(0).select(kept)
    return rasterize(gaussians, experiment.camera(frame), torch.ones(3)).image.clamp(0, 1)


def _mouth_psnr(
    experiment: Experiment, frames: Sequence[Frame], model: FaceModel, kept: Bool[Tensor, " n"] | None = None
) -> float:
    """The mean PSNR of the mouth, whose place is that of `model`: one without teeth would have another box."""
    values = []
    for frame in frames:
        box = mouth_box(model, experiment.face(frame), experiment.camera(frame))
        values.append(psnr(_image(experiment, frame, kept), target_image(experiment, frame), box))
    return round(sum(values) / len(values), 3)


def _beside_truth(experiment: Experiment, frame: Frame, kept: Bool[Tensor, " n"], index: int) -> Picture:
    images = (target_image(experiment, frame), _image(experiment, frame, None), _image(experiment, frame, kept))
    box = mouth_box(experiment.avatar.face_model, experiment.face(frame), experiment.camera(frame))
    cut = [crop_to(image, box) for image in images]
    # At the size of the other pictures, without smoothing.
    rows, columns = (torch.arange(_SIDE) * size // _SIDE for size in cut[0].shape[:2])
    name = experiment.sequences[frame.sequence].name
    return Picture(
        f"teeth-frame-{index + 1}",
        side_by_side([to_uint8(image[rows][:, columns]) for image in cut]),
        f"{name}, timestep {frame.timestep}, held out: truth, with, and without the Gaussians on the teeth.",
    )


def scale(context: Context) -> Result:
    """The same short training with the threshold of the scale loss, and with a threshold of 0: section C."""
    config, usual = context.avatar.config, GaussianAvatarsConfig()
    assert isinstance(config, GaussianAvatarsConfig)
    threshold = config.scale_threshold or usual.scale_threshold
    context.say_how_long("scale", 2)
    runs = {
        f"threshold {threshold:g}": context.train("scale-threshold", replace(config, scale_threshold=threshold)),
        "no threshold (0)": context.train("scale-no-threshold", replace(config, scale_threshold=0.0)),
    }
    avatars = [run.timed_avatar for run in runs.values()]
    drawn = measuring.measure_in_turn(avatars, context.camera.fitted(550, 802), context.options.seconds)
    sizes, late = ([measure(run) for run in runs.values()] for measure in (_median_scale, _late_step_ms))
    rows = [
        (name, run.summary["gaussians"], round(size, 3), round(step, 1), round(draw, 1), _score(run))
        for (name, run), size, step, draw in zip(runs.items(), sizes, late, drawn, strict=True)
    ]
    names = ("name", "gaussians", "median_scale", "step_ms", "draw_ms", "head_psnr")
    with_threshold, without = (dict(zip(names, row, strict=True)) for row in rows)
    slower_step, slower_draw = late[1] / max(late[0], 1e-9), drawn[1] / max(drawn[0], 1e-9)
    findings = [
        f"Without the threshold, a step takes {slower_step:.2f} times as long at the end and drawing {slower_draw:.2f} "
        f"times as long, after {context.options.steps:,} steps. The supplement says, without a figure, that drawing "
        "would become substantially slower."
    ]
    if without["head_psnr"] is not None:
        findings.append(
            f"The median of the scales is {sizes[1]:.2g} of a triangle without the threshold and {sizes[0]:.2g} with "
            f"it; PSNR of the head crop is {without['head_psnr']:.2f} dB "
            f"without and {with_threshold['head_psnr']:.2f} dB with it."
        )
    heading = (
        "", "Gaussians", "Median scale, triangle units", "Step at the end, ms", "Drawing 550x802, ms",
        "PSNR of the head crop, dB",
    )  # fmt: skip
    return Result(
        {
            "steps": context.options.steps,
            "rows": [with_threshold, without],
            "step_slower_without": round(slower_step, 3),
            "drawing_slower_without": round(slower_draw, 3),
        },
        findings,
        [Table(heading, rows)],
        notes=[
            "With a threshold of 0, the loss shrinks every Gaussian. The supplement expects that more of them are then "
            "blended before a ray ends. Both trainings have the same settings, seed and frames.",
            "Drawing is timed in turn, so that other work on the machine slows both alike. Steps are timed one "
            "training after the other.",
        ],
    )


def _median_scale(run: Run) -> float:
    """The median, over the Gaussians, of the largest scale in units of the triangle."""
    return float(torch.exp(run.avatar.store["log_scales"].detach()).amax(-1).median())


def _late_step_ms(run: Run) -> float:
    """The median time of the last fifth of the steps."""
    times = run.curves["step_ms"]
    return float(np.median(times[-max(1, round(0.2 * len(times))) :]))


def _score(run: Run) -> float | None:
    if run.experiment is None:
        return None
    return round(mean_psnr(run.experiment, spread_frames(run.experiment.held_out_frames, 16)), 2)
