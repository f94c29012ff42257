"""The parts of report.html with pictures and charts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mien.avatar.avatar import Avatar
from mien.camera import Box
from mien.evaluation.experiment import DARK, Experiment, avatar_image, head_box, target_image
from mien.evaluation.living import SIDE, Living, strip, to_bytes
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import BASELINE_NAMES, OVER_DARK_NAME
from mien.evaluation.page_parts import Card, Cell, DataTable, Picture, figure_text, picture_of, video_of
from mien.evaluation.protocols import AVATAR, MESH, OVER_DARK, Evaluation
from mien.media.pictures import error_heat, picture_uri, to_uint8
from mien.pages.pages import Axes, Series, line_chart
from mien.render.mesh import render_mesh
from mien.training.footage.coverage import Coverage
from mien.training.footage.filmed import confidence_picture, filmed_words
from mien.training.footage.frames import Frame

_PICTURE_SIZE = 400
_OVERLAY_SIZE = 300
_ROWS = 6
_OVERLAYS = 6
_SMOOTHING = 15
_SIDES = {-90: "right side", -45: "45 degrees to the right", 0: "front", 45: "45 degrees to the left",
          90: "left side", 180: "back"}  # fmt: skip
_CONFIDENCE_NOTE = (
    "Blue surfaces were seen squarely by the camera in some training pictures. Orange ones were never seen; their "
    "colours are spread or mirrored from seen ones. Grey ones are below the cut at the neck and are not shown."
)
_CROSS_COLUMNS = (
    ("expression_error", "Expression ↓", 4), ("expression_error_still", "if still", 4),
    ("head_rotation_error_degrees", "Head, ° ↓", 2), ("head_rotation_error_still_degrees", "if still", 2),
    ("mouth_correlation", "Mouth r ↑", 2), ("eyes_correlation", "Eyes r ↑", 2), ("faces_found", "Faces found ↑", 2),
    ("frames", "Frames", 0),
)  # fmt: skip
_CROSS_NOTE = (
    "There is no true picture, so a face detector reads the pictures of the driver and of the avatar, and the motions "
    "that it finds are compared, each relative to its own neutral face. Expression: distance between the motions of "
    "lips, lids and brows without the head pose; the unit is the distance between the outer eye corners. Head: "
    "difference of the head rotations. If still: the same figure for an avatar that never moves. r: correlation of the "
    "openings of mouth and eyes over the frames. The figures show how much of the motion arrives, not how good the "
    "pictures look."
)


def comparison(experiment: Experiment, evaluation: Evaluation) -> list[dict[str, Any]]:
    """Truth, rendering and error of the best, the median and the worst held-out frame, and of some between."""
    ranked = evaluation.ranked()
    middle = len(ranked) // 2
    places = _places(len(ranked), middle)
    names = {len(ranked) - 1: "best", middle: "median", 0: "worst"}
    box = head_box(experiment, [evaluation.frames[ranked[place]] for place in places])
    return [_compared_frame(experiment, evaluation, ranked[place], names.get(place, ""), box) for place in places]


def _places(count: int, middle: int) -> list[int]:
    """Evenly spread ranks from the last to the first. The inner rank nearest to the median becomes the median."""
    places = sorted(set(np.linspace(0, count - 1, min(_ROWS, count)).round().astype(int).tolist()))
    if len(places) > 2:
        nearest = min(range(1, len(places) - 1), key=lambda index: abs(places[index] - middle))
        places[nearest] = middle
    return places[::-1]


def _compared_frame(experiment: Experiment, evaluation: Evaluation, index: int, rank: str, box: Box) -> dict[str, Any]:
    frame, scores = evaluation.frames[index], evaluation.scores[AVATAR][index]
    target, image = target_image(experiment, frame), avatar_image(experiment, frame)
    whole = (to_uint8(target), to_uint8(image), error_heat(image, target))
    pictures = [crop_to(torch.from_numpy(picture), box).numpy() for picture in whole]
    figures = f"PSNR {scores['psnr']:.2f} dB, head {scores['head_psnr']:.2f} dB, SSIM {scores['ssim']:.3f}"
    if "perceptual" in scores:
        figures += f", ST-LPIPS {scores['perceptual']:.3f}"
    shown = [
        picture_of(picture, what, _PICTURE_SIZE)
        for picture, what in zip(pictures, ("truth", "rendering", "error"), strict=True)
    ]
    return {"rank": rank, "frame": frame_name(experiment, frame), "figures": figures, "pictures": shown}


def over_time(experiment: Experiment, evaluation: Evaluation) -> list[Card]:
    """PSNR of the head crop over the timesteps of each sequence and camera, with held-out spans shaded."""
    pairs = sorted({(frame.sequence, frame.camera) for frame in evaluation.frames})
    charts = []
    for sequence, camera in pairs[:4]:
        here = [f for f in evaluation.training_psnr if (f.sequence, f.camera) == (sequence, camera)]
        there = [i for i, f in enumerate(evaluation.frames) if (f.sequence, f.camera) == (sequence, camera)]
        timesteps = [evaluation.frames[i].timestep for i in there]
        seen = [evaluation.training_psnr[f][1] for f in here]
        series = [_series("training frames", [f.timestep for f in here], seen, "quiet")]
        mesh = f"{BASELINE_NAMES['mesh']}, held-out frames"
        for subject, label, style in ((AVATAR, "held-out frames", "main"), (MESH, mesh, "second")):
            if subject in evaluation.scores:
                series.append(
                    _series(label, timesteps, [evaluation.scores[subject][i]["head_psnr"] for i in there], style)
                )
        axes = Axes("timestep", "PSNR, head crop, dB", 1080, 260, shaded=spans(timesteps))
        title = frame_name(experiment, Frame(sequence, -1, camera))
        charts.append(Card(f"PSNR on the head crop, dB · {title}", line_chart(series, axes)))
    return charts


def spans(timesteps: Sequence[int]) -> tuple[tuple[float, float], ...]:
    """Runs of consecutive timesteps as intervals that extend half a step beyond their ends."""
    found: list[tuple[float, float]] = []
    for timestep in sorted(timesteps):
        if found and timestep - 0.5 == found[-1][1]:
            found[-1] = (found[-1][0], timestep + 0.5)
        else:
            found.append((timestep - 0.5, timestep + 0.5))
    return tuple(found)


def training_curves(curves: Mapping[str, np.ndarray]) -> list[Card]:
    """Loss, PSNR, number of Gaussians and step time over the steps of training."""
    steps = np.asarray(curves["step"], dtype=np.float64)
    kinds = (
        ("loss", "Loss", True),
        ("psnr", "PSNR of the training picture, dB", False),
        ("gaussians", "Gaussians", True),
        ("step_ms", "Step time, ms", True),
    )
    cards = []
    for name, title, from_zero in kinds:
        values = np.asarray(curves[name], dtype=np.float64)
        if name == "step_ms":
            # The first step fills caches, and a single late outlier would flatten the rest.
            values = np.minimum(values, np.percentile(values, 99))
        series = [Series(title, steps, values)]
        if name in ("loss", "psnr"):
            series = [Series("single frames", steps, values, "quiet"), Series("mean", *_smooth(steps, values))]
        cards.append(Card(title, line_chart(series, Axes("step", title, from_zero=from_zero))))
    return cards


def _smooth(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean over a sliding window of one fifteenth of the curve."""
    width = max(1, len(y) // _SMOOTHING)
    window = np.full(width, 1 / width)
    return np.convolve(x, window, "valid"), np.convolve(y, window, "valid")


@torch.no_grad()
def tracking_overlays(experiment: Experiment) -> list[dict[str, Any]]:
    """The tracked mesh over evenly spread frames, and the landmark residuals over time."""
    parts = []
    for index, sequence in enumerate(experiment.sequences):
        usable = np.argwhere(sequence.usable())
        chosen = usable[np.linspace(0, len(usable) - 1, min(_OVERLAYS, len(usable))).round().astype(int)]
        pictures = [_overlay(experiment, Frame(index, int(t), int(c))) for t, c in chosen]
        residuals = sequence.tracking.residuals.double().numpy()
        timesteps = np.arange(len(residuals), dtype=np.float64)
        lines = [Series("residual", timesteps, np.ascontiguousarray(residuals[:, 0]))]
        median = float(np.nanmedian(residuals)) if np.isfinite(residuals).any() else float("nan")
        title = f"Landmark residual, median of each frame, pixels · {sequence.name} · median {median:.2f} px"
        chart = line_chart(lines, Axes("timestep", "residual, pixels", 1080, 200, from_zero=True))
        parts.append({"pictures": pictures, "residuals": Card(title, chart)})
    return parts


def _overlay(experiment: Experiment, frame: Frame) -> Picture:
    sequence, camera = experiment.sequences[frame.sequence], experiment.camera(frame)
    picture = torch.from_numpy(sequence.capture.images[frame[1:]].astype(np.float32)) / 255
    face_model = experiment.avatar.face_model
    vertices = face_model(sequence.tracking.face[frame.timestep])[0]
    mesh, alpha = render_mesh(vertices, face_model.faces, camera, supersample=2)
    blended = picture * (1 - 0.6 * alpha[..., None]) + 0.6 * alpha[..., None] * mesh
    caption = f"timestep {frame.timestep}"
    return picture_of(to_uint8(blended), "tracked mesh over the frame", _OVERLAY_SIZE, caption)


def baseline_pictures(experiment: Experiment, evaluation: Evaluation) -> list[Picture]:
    """The median held-out frame as truth, mean training picture, coloured mesh and avatar; none without baselines.

    If the avatar is scored over dark blue, truth and avatar are shown over it, too: holes do not show over white.
    """
    if evaluation.baselines is None:
        return []
    frame = evaluation.frames[evaluation.ranked()[len(evaluation.frames) // 2]]
    pictures = {
        "truth": target_image(experiment, frame),
        BASELINE_NAMES["mean_frame"]: evaluation.baselines.mean_frame_image(experiment, frame),
        BASELINE_NAMES["mesh"]: evaluation.baselines.mesh_image(experiment, frame),
        "avatar": avatar_image(experiment, frame),
    }
    if OVER_DARK in evaluation.scores:
        pictures[f"truth, {OVER_DARK_NAME}"] = target_image(experiment, frame, DARK)
        pictures[f"avatar, {OVER_DARK_NAME}"] = avatar_image(experiment, frame, background=DARK)
    return [picture_of(to_uint8(picture), name, _PICTURE_SIZE, name) for name, picture in pictures.items()]


@torch.no_grad()
def confidence(avatar: Avatar, coverage: Coverage) -> dict[str, Any]:
    """The neutral head coloured by how well training pictures show it: from the front, the side and behind."""
    neutral = avatar.face_model.head_vertices(avatar.subject)[0].cpu().float()
    model = avatar.face_model.to(neutral)
    pictures = []
    for yaw, name in _SIDES.items():
        picture = confidence_picture(model, neutral, coverage, yaw, _OVERLAY_SIZE)
        pictures.append(picture_of(to_uint8(picture), name, _OVERLAY_SIZE, name))
    note = f"{filmed_words(model, neutral, coverage)}. {_CONFIDENCE_NOTE}"
    return {"pictures": pictures, "note": note[0].upper() + note[1:]}


def cross_section(entry: Mapping[str, Any], videos: Sequence[Path], page_folder: Path) -> dict[str, Any]:
    """The table and the videos of cross-reenactment."""
    head = [Cell("Driver"), *(Cell(name) for _, name, _ in _CROSS_COLUMNS)]
    rows = [
        [Cell(driver["driver"]), *(Cell(figure_text(driver[key], digits)) for key, _, digits in _CROSS_COLUMNS)]
        for driver in entry["drivers"]
    ]
    shown = [video_of(path, page_folder, "Driver, avatar") for path in videos]
    return {"table": DataTable([head], rows, _CROSS_NOTE), "videos": shown}


def hero(alive: Living, film: Path, result: tuple[Experiment, Evaluation]) -> dict[str, Any]:
    """The avatar alive, the first held-out frame beside it, and a strip of its faces."""
    experiment, evaluation = result
    picture = to_bytes(alive.avatar.render(camera=alive.camera)[0])
    filmed = to_uint8(target_image(experiment, evaluation.frames[0]))
    faces = [
        picture_of(face, f"The avatar: {name}", _OVERLAY_SIZE, name.replace("_", " ").capitalize())
        for name, face in strip(alive)
    ]
    return {
        "film": video_of(film, film.parent, "The avatar in motion"),
        "poster": picture_uri(picture),
        "filmed": picture_of(filmed, "A filmed frame", SIDE, "A filmed frame that training never saw"),
        "faces": faces,
    }


def frame_name(experiment: Experiment, frame: Frame) -> str:
    """A frame in words. A timestep below 0 means all timesteps. The camera is named if there are several."""
    sequence = experiment.sequences[frame.sequence]
    parts = [sequence.name]
    if len(sequence.capture.camera_ids) > 1:
        parts.append(f"camera {experiment.camera_id(frame)}")
    if frame.timestep >= 0:
        parts.append(f"timestep {frame.timestep}")
    return ", ".join(parts)


def _series(label: str, x: Sequence[int], y: Sequence[float], style: str) -> Series:
    return Series(label, np.array(x, dtype=np.float64), np.array(y, dtype=np.float64), style, points=True)
