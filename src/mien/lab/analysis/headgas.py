"""The analysis of HeadGaS (Dhamo et al., ECCV 2024): the figures of the paper's supplement.

`headgas_ablations` has its table of ablations.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mien.avatar.headgas.avatar import HeadGas
from mien.camera import Camera
from mien.errors import UserError
from mien.evaluation.metrics import crop_to
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import Gaussians, world_means
from mien.lab.analysis import measuring
from mien.lab.analysis.headgas_ablations import ablations as ablations
from mien.lab.analysis.headgas_ablations import busy_face
from mien.lab.analysis.result import Chart, Film, Picture, Result, Table
from mien.lab.analysis.running import Context
from mien.lab.benchmarking.timing import format_machine, measure_machine
from mien.machine.progress import track_progress
from mien.media.pictures import picture_grid, side_by_side
from mien.media.video import write_video
from mien.pages.pages import Axes, Series
from mien.render.camera_paths import turned_camera
from mien.runtime.filmed import head_angles
from mien.training.footage.sequence import Sequence as TrainedSequence
from mien.training.run import read_face_track

SIDE = 224
"""Width and height of a picture, in pixels."""
_FPS = 25.0
_INNER_LIPS, _EYE_CORNERS = (13, 14), (33, 263)
"""Landmarks in the middle of the inner lips, and at the outer eye corners."""
_FAINT = 1 / 255
"""Opacity below which a Gaussian is not drawn."""
_REACH = 1.4
"""Largest multiple of the training maximum: the supplement's own."""
SIZES = {512: 4.0, 1024: 5.0, 2048: 8.6}
"""Side of a square picture in pixels -> mean milliseconds of a frame, for 21,000 to 37,000 Gaussians on a GPU."""


@dataclass(frozen=True, eq=False)
class Trained:
    """The range of a training."""

    highest: Float[Tensor, " e"]
    """The largest value of each expression coefficient."""
    yaws: tuple[float, float]
    """Lowest and highest yaw of the camera as the head sees it, in radians. Positive is the subject's left."""
    yaw_at_rest: float
    """The same for the subject and the run's camera, in radians."""


def trained_range(context: Context) -> Trained:
    """The range of the run's training."""
    subject, filmed = context.avatar.subject, context.avatar.filmed
    assert filmed is not None, "only avatars of other programs have no range, and none of them is of this method"
    low, high = (float(value) for value in filmed.head_angles[0])
    parts = (subject.head_rotation, subject.head_translation, context.camera.position)
    at_rest = head_angles(*(part.detach().cpu().numpy() for part in parts))[0, 0]
    return Trained(torch.from_numpy(filmed.highest[: subject.expression.shape[1]].copy()), (low, high), float(at_rest))


def with_expression(face: FaceParams, index: int, value: float) -> FaceParams:
    """The face with one expression coefficient set to a value."""
    expression = face.expression.clone()
    expression[:, index] = value
    return replace(face, expression=expression)


def _avatar_and_mesh(context: Context, face: FaceParams, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    return measuring.draw_avatar(context.avatar, face, camera), measuring.draw_mesh(
        context.avatar.face_model, face, camera
    )


def basis(context: Context) -> Result:
    """The avatar with each expression alone, and the mesh with the same expression: Fig. 1."""
    assert isinstance(avatar := context.avatar, HeadGas)
    model, (start, added) = avatar.face_model, start_of_bases(avatar.subject, avatar.face_model)
    camera = measuring.head_camera(model, start, context.camera, SIDE)

    def alone(index: int, value: float) -> FaceParams:
        return with_expression(start, index, float(start.expression[0, index]) * added + value)

    names, highest = model.expression_names, trained_range(context).highest
    first, mesh = measuring.draw_avatar(avatar, start, camera).astype(np.float32), model(start)[0]
    rows = []
    for index in track_progress(range(len(names)), "basis", len(names)):
        value = float(model.expression_bounds[index, 1].clamp(0, 1))
        face = alone(index, value)
        change = float(np.abs(measuring.draw_avatar(avatar, face, camera) - first).mean())
        moved = 1e3 * float((model(face)[0] - mesh).norm(dim=-1).max())
        rows.append((names[index], round(value, 3), round(float(highest[index]), 3), round(change, 3), round(moved, 2)))
    # What training reached farthest, as a share of what is drawn, comes first.
    order = sorted(range(len(names)), key=lambda i: (-min(rows[i][2] / max(rows[i][1], 1e-6), 1), -rows[i][4], i))
    shown = [index for index in order if rows[index][1] > 0][:12]

    def pair(index: int, value: float, digits: str) -> np.ndarray:
        drawn = _avatar_and_mesh(context, alone(index, value), camera)
        return measuring.labeled(side_by_side(drawn[::-1]), f"{names[index]} {value:{digits}}")

    def film() -> Iterator[np.ndarray]:
        for index, frame in product(shown, range(16)):
            most = min(1.0, float(model.expression_bounds[index, 1]))
            yield pair(index, most * math.sin(math.pi * frame / 16) ** 2, ".2f")

    write_video(context.folder / "basis.mp4", film(), _FPS)
    seen = sum(row[2] >= 0.5 * row[1] for row in rows if row[1] > 0)
    columns = {
        "name": "Expression", "value": "Drawn at", "largest_in_training": "Largest in training",
        "picture_change": "Change of the picture, of 255", "mesh_moves_mm": "Mesh moves at most, mm",
    }  # fmt: skip
    base = "added to the person at rest" if added else "alone"
    caption = f"The 12 expressions that training reached farthest, each {base}: the mesh, and the avatar."
    grid = picture_grid([pair(index, rows[index][1], "g") for index in shown], 3)
    return Result(
        {"neutral_added": bool(added), "seen": seen, "rows": [dict(zip(columns, row, strict=True)) for row in rows]},
        [
            f"Training reached at least half of the drawn value in {seen} of {len(rows)} expressions; the others are "
            "extrapolated."
        ],
        [Table(list(columns.values()), [rows[index] for index in order])],
        pictures=[Picture("basis", grid, caption)],
        films=[Film("basis.mp4", "The same expressions, one after the other, from nothing to their value and back.")],
        notes=[
            "Each expression is drawn at 1, or at the bound of the face model if that is smaller. The other "
            + ("coefficients are those of the person at rest." if added else "coefficients are 0."),
            f"Features of this run change along {avatar.directions.shape[1]} directions of "
            f"{avatar.directions.shape[0]} inputs (--method.directions). "
            "What expressions have in common along them looks alike.",
        ],
    )


def start_of_bases(subject: FaceParams, model: FaceModel) -> tuple[FaceParams, int]:
    """The face to which single expressions are added, and 1 if it is the person at rest, or 0 if all expressions are 0.

    Coefficients that can be negative have no meaning of their own, and the person at rest is far from 0 in them. The
    supplement adds those of a neutral frame then.
    """
    if bool((model.expression_bounds[:, 0] < 0).any()):
        return subject, 1
    return replace(subject, expression=torch.zeros_like(subject.expression)), 0


def layers(context: Context) -> Result:
    """The avatar at rest, and its mouth in a filmed frame with shut lips, without the nearest Gaussians: Fig. 2."""
    avatar, model, subject = context.avatar, context.avatar.face_model, context.avatar.subject
    shut, told, truth = _shut_frame(context)
    face, filming = (subject, context.camera) if shut is None else shut
    views = {
        "head": (subject, measuring.head_camera(model, subject, context.camera, SIDE)),
        "mouth": (face, measuring.mouth_camera(model, face, filming, SIDE)),
    }
    with torch.no_grad():
        posed = {name: avatar.pose(one).gaussians.timestep(0) for name, (one, _) in views.items()}
    orders, gaussians = {name: near_to_far(posed[name], views[name][1]) for name in views}, posed["head"]

    def without(name: str, share: float) -> np.ndarray:
        return measuring.draw_avatar(avatar, *views[name], without_nearest(len(gaussians), orders[name], share))

    def film() -> Iterator[np.ndarray]:
        for frame in range(75):
            share = 0.5 * frame / 74
            yield measuring.labeled(
                side_by_side([without(name, share) for name in views]), f"without {100 * share:.0f} %"
            )

    pictures, values = [], {"gaussians": len(gaussians), "faint": int((gaussians.opacities < _FAINT).sum())}
    for name, order in orders.items():
        values[f"in_{name}"] = len(order)
        shares = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
        drawn = [measuring.labeled(without(name, share), f"without {100 * share:.0f} %") for share in shares]
        at = told if name == "mouth" else "The head of the person at rest"
        drawn = [*(truth if name == "mouth" else ()), *drawn]
        caption = f"{at}, without the nearest Gaussians among the {len(order):,} in view."
        pictures.append(Picture(f"layers-{name}", side_by_side(drawn), caption))
    write_video(context.folder / "layers.mp4", film(), _FPS)
    return Result(
        values,
        [
            f"{100 * values['faint'] / max(len(gaussians), 1):.0f} % of the {len(gaussians):,} Gaussians are not drawn "
            "in this expression, because they are fainter than 1/255."
        ],
        pictures=pictures,
        films=[Film("layers.mp4", "Head and mouth, while up to half of the Gaussians in view are removed.")],
        notes=[
            "The supplement finds teeth behind closed lips. Look whether they appear here too: that needs other frames "
            "with visible teeth.",
            "Only Gaussians that are drawn and whose centre is in the picture count. White shows through where no "
            "Gaussian is behind, because no frame shows what is there.",
        ],
    )


def _shut_frame(context: Context) -> tuple[tuple[FaceParams, Camera] | None, str, list[np.ndarray]]:
    """Face and camera of the frame with shut lips (None: nothing tells), what it is, and its picture of the mouth."""
    try:
        place, reason = shut_lips(context.sequences), "no picture has landmarks"
    except UserError as error:
        place, reason = None, str(error)
    if place is None:
        return None, f"The mouth of the person at rest ({reason})", []
    index, timestep = place
    sequence, model = context.sequences[index], context.avatar.face_model
    before = sum(len(one.tracking.face) for one in context.sequences[:index])
    face = read_face_track(context.run_dir, model)[before + timestep]
    left, top, width, _ = measuring.mouth_box(model, face, camera := sequence.tracking.cameras[0])
    picture = crop_to(torch.from_numpy(np.array(sequence.capture.images[timestep, 0])), (left, top, width, width))
    picture = cv2.resize(picture.numpy(), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    told = f"The mouth in {sequence.name}, timestep {timestep}, whose lips are shut: as filmed, then the avatar"
    return (face, camera), told, [measuring.labeled(picture, "filmed")]


def shut_lips(sequences: Sequence[TrainedSequence]) -> tuple[int, int] | None:
    """Sequence and timestep with shut lips: the most frontal view among the tenth whose lips are least apart.

    The gap between the lips is that of the landmarks in the first camera's pictures, relative to the distance of the
    outer eye corners. None if no picture has landmarks.
    """
    found = []
    for index, one in enumerate(sequences):
        marks, face = one.capture.landmarks[:, 0].astype(np.float64), one.tracking.face
        inner, corners = (np.linalg.norm(marks[:, a] - marks[:, b], axis=1) for a, b in (_INNER_LIPS, _EYE_CORNERS))
        eye = one.tracking.cameras[0].position.numpy()
        turned = np.linalg.norm(head_angles(face.head_rotation.numpy(), face.head_translation.numpy(), eye), axis=1)
        for timestep in np.flatnonzero(one.usable()[:, 0] & np.isfinite(inner) & (corners > 0)).tolist():
            found.append((inner[timestep] / corners[timestep], turned[timestep], index, timestep))
    least = sorted(found)[: max(1, len(found) // 10)]
    return min(least, key=lambda each: each[1])[2:] if least else None


def near_to_far(gaussians: Gaussians, camera: Camera) -> Int[Tensor, " p"]:
    """Indices of the Gaussians that a camera draws and whose centre it sees, nearest first."""
    pixels, depth = camera.project(world_means(gaussians))
    size = pixels.new_tensor([camera.width, camera.height])
    seen = ((pixels >= 0) & (pixels < size)).all(-1) & (depth > 0) & (gaussians.opacities >= _FAINT)
    indices = seen.nonzero()[:, 0]
    return indices[depth[indices].argsort(stable=True)]


def without_nearest(count: int, order: Int[Tensor, " p"], share: float) -> Bool[Tensor, " n"]:
    """All of `count` Gaussians but the first of `order`, of which `share` is left out."""
    kept = torch.ones(count, dtype=torch.bool)
    kept[order[: round(share * len(order))]] = False
    return kept


def beyond(context: Context) -> Result:
    """The avatar with one expression beyond its training maximum, and from views beyond those of training: Fig. 3."""
    trained = trained_range(context)
    index, yaws = strongest_expression(context, trained), shown_yaws(trained)
    name, most = context.avatar.face_model.expression_names[index], float(trained.highest[index])
    shown = {factor: _expressed(context, index, factor * most) for factor in (0.0, 0.5, 1.0, 1.1, 1.2, 1.3, _REACH)}
    grid = [measuring.labeled(picture, f"{factor:g} x largest") for factor, (picture, _) in shown.items()]
    grid += [measuring.labeled(mesh, "") for _, mesh in shown.values()]
    views = [measuring.labeled(_seen_from(context, trained, yaw), f"{math.degrees(yaw):+.0f} degrees") for yaw in yaws]
    write_video(context.folder / "beyond-expression.mp4", _expression_film(context, index, most), _FPS)
    write_video(context.folder / "beyond-view.mp4", _view_film(context, trained), _FPS)
    factors, changes = _changes(context, index, most)
    inside, outside = (float(changes[part].mean()) for part in (factors <= 1.001, factors > 1.001))
    low, high = (math.degrees(yaw) for yaw in trained.yaws)
    title, series = f"Change of the picture by a tenth more of {name}", [Series("this run", factors, changes)]
    axes = Axes("times the largest training value", "mean change, of 255", from_zero=True, shaded=((1.0, _REACH),))
    return Result(
        {
            "expression": name,
            "largest_in_training": round(most, 4),
            "factors": factors.round(2).tolist(),
            "picture_change": changes.round(4).tolist(),
            "training_yaw_degrees": [round(low, 1), round(high, 1)],
            "shown_yaw_degrees": [round(math.degrees(yaw), 1) for yaw in yaws],
        },
        [
            f"From 1 to {_REACH:g} times the largest training value of {name}, a tenth more changes the picture by "
            f"{outside:.2f} of 255 on average, and {inside:.2f} below. The supplement sees colours deteriorate from "
            "1.2 times on.",
            f"Training saw the head from {low:.0f} to {high:.0f} degrees (yaw, positive to the subject's left). "
            "Pictures go 30 degrees farther on both sides.",
        ],
        charts=[Chart("beyond-change", title, series, axes, "Shaded: what training did not see.")],
        pictures=[
            Picture("beyond-expression", picture_grid(grid, len(shown)), f"{name}, and the mesh below."),
            Picture("beyond-view", side_by_side(views), "The person at rest; the outer two on each side are unseen."),
        ],
        films=[
            Film("beyond-expression.mp4", f"{name} from 0 to {_REACH:g} times its largest training value."),
            Film("beyond-view.mp4", "The camera from one side to the other, beyond the training views on both."),
        ],
        notes=["`mien render --set` refuses such values for users; this part poses the avatar itself."],
    )


def _expressed(context: Context, index: int, value: float) -> tuple[np.ndarray, np.ndarray]:
    """The avatar at rest but for one expression, and the mesh."""
    avatar, model = context.avatar, context.avatar.face_model
    camera = measuring.head_camera(model, avatar.subject, context.camera, SIDE)
    return _avatar_and_mesh(context, with_expression(avatar.subject, index, value), camera)


def _changes(context: Context, index: int, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Factors, and the mean change of the picture from a tenth less to each of them, of 255."""
    factors = np.arange(0, round(10 * _REACH) + 1) / 10
    drawn = [_expressed(context, index, factor * most)[0].astype(np.float32) for factor in factors]
    return factors[1:], np.array([float(np.abs(second - first).mean()) for first, second in pairwise(drawn)])


def _seen_from(context: Context, trained: Trained, yaw: float) -> np.ndarray:
    return measuring.draw_avatar(context.avatar, context.avatar.subject, view_from(context, trained, yaw))


def _expression_film(context: Context, index: int, most: float) -> Iterator[np.ndarray]:
    for frame in range(60):
        factor = _REACH * frame / 59
        yield measuring.labeled(side_by_side(_expressed(context, index, factor * most)), f"{factor:.2f} x largest")


def _view_film(context: Context, trained: Trained) -> Iterator[np.ndarray]:
    first, *_, last = shown_yaws(trained)
    for frame in range(60):
        yaw = first + (last - first) * frame / 59
        told = "seen" if trained.yaws[0] <= yaw <= trained.yaws[1] else "unseen"
        yield measuring.labeled(_seen_from(context, trained, yaw), f"{math.degrees(yaw):+.0f} degrees, {told}")


def strongest_expression(context: Context, trained: Trained) -> int:
    """The expression that moves the mesh most at its largest training value."""
    basis = context.avatar.face_model.expression_basis
    return int((trained.highest.clamp_min(0) * basis.flatten(1).norm(dim=-1)).argmax())


def shown_yaws(trained: Trained) -> list[float]:
    """Yaws of the pictures in radians: 30 and 15 degrees beyond the training views, at their ends, in the middle."""
    (low, high), far, farther = trained.yaws, math.radians(15.0), math.radians(30.0)
    return [low - farther, low - far, low, 0.5 * (low + high), high, high + far, high + farther]


def view_from(context: Context, trained: Trained, yaw: float) -> Camera:
    """The camera, moved around the person at rest until the head sees it at this yaw, in radians."""
    subject = context.avatar.subject
    camera = measuring.head_camera(context.avatar.face_model, subject, context.camera, SIDE)
    return turned_camera(camera, subject.head_translation[0], yaw - trained.yaw_at_rest, 0.0)


def sizes(context: Context) -> Result:
    """Milliseconds of a frame with a changed expression, at all threads, against the size of the picture: Fig. 4."""
    face, seconds = busy_face(context), context.options.seconds
    machine = format_machine(measure_machine(gpu=context.like.is_cuda))
    rows: list[dict[str, Any]] = []
    for side in track_progress(list(SIZES), "sizes", len(SIZES)):
        row = measuring.measure_drawing(context.timed_avatar, context.camera.fitted(side, side), seconds, face)
        rows.append({**row, "frame_ms": round(row["draw_ms"] + row["pose_ms"], 3), "paper_ms": SIZES[side]})
    cells = [
        (
            f"{row['width']}x{row['height']}", round(row["frame_ms"], 1), row["paper_ms"], round(row["pose_ms"], 1),
            round(row["draw_ms"], 1), row["pictures"],
        )
        for row in rows
    ]  # fmt: skip
    heading = ("Width x height", "Frame, ms", "Paper, ms", "Features and network, ms", "Drawing, ms", "Pictures timed")
    count, threads, place = len(context.avatar.store), rows[0]["threads"], measuring.measured_on(rows[0])
    names = ("width", "frame_ms", "paper_ms")
    sides, ours, paper = (np.array([row[name] for row in rows], np.float64) for name in names)
    slower = rows[-1]["frame_ms"] / max(rows[0]["frame_ms"], 1e-6)
    pixels = (max(SIZES) // min(SIZES)) ** 2
    series = [
        Series(f"this run, {place}", sides, ours / max(ours[0], 1e-6)),
        Series("paper, a GPU", sides, paper / paper[0], "second"),
    ]
    axes = Axes("side of the picture, pixels", "times the smallest", from_zero=True)
    return Result(
        {"machine": machine, "gaussians": count, "threads": threads, "rows": rows, "slower": round(slower, 3)},
        [
            f"{count:,} Gaussians, {place}: {rows[0]['frame_ms']:.1f} ms at "
            f"{min(SIZES)}x{min(SIZES)}. With {pixels} times the pixels, a frame takes {slower:.1f} times as long "
            f"(paper, on a GPU: {paper[-1] / paper[0]:.1f} times)."
        ],
        [Table(heading, cells, machine)],
        [Chart("sizes", "Fig. 4: time of a frame, relative to the smallest picture", series, axes)],
        notes=[
            "A frame is posed at an expression in which no coefficient is 0, and drawn from the camera of training, "
            f"fitted into the picture, over white. Times are medians; each row took about {seconds:g} s."
        ],
    )
