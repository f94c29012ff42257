"""What the bases learned: the avatar with one expression at a time, beside the mesh (Fig. 1 of the supplement)."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from mien.avatar.headgas.avatar import HeadGas
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.lab.analysis.context import Context
from mien.lab.analysis.headgas.trained import trained_range, with_expression
from mien.lab.analysis.result import Film, PartResult, Picture, Table
from mien.lab.analysis.views import draw_avatar, draw_mesh, head_camera, labeled
from mien.machine.progress import track_progress
from mien.media.pictures import picture_grid, side_by_side
from mien.media.video import write_video

_SHOWN, _COLUMNS = 12, 3
"""Number of expressions that are shown, and of those in a row."""
SIDE = 224
"""Width and height of a picture, in pixels."""
_FRAMES, _FPS = 16, 25
"""Frames of the film for each expression, and frames per second."""
_WELL_SEEN = 0.5
"""Share of the drawn value that training has to reach for an expression to count as seen."""


def basis(context: Context) -> PartResult:
    """Draw the avatar with each expression alone, and the mesh with the same expression."""
    avatar, model = context.avatar, context.avatar.face_model
    assert isinstance(avatar, HeadGas)
    start, added = start_of_bases(avatar.subject, model)
    values = model.expression_bounds[:, 1].clamp(0, 1)
    highest = trained_range(context).highest
    camera = head_camera(model, start, context.camera, SIDE)
    first, mesh = draw_avatar(avatar, start, camera).astype(np.float32), model(start)[0]
    rows = []
    names = model.expression_names
    for index in track_progress(range(len(names)), "basis", len(names)):
        value = float(values[index])
        face = with_expression(start, index, float(start.expression[0, index]) * added + value)
        change = float(np.abs(draw_avatar(avatar, face, camera) - first).mean())
        moved = 1e3 * float((model(face)[0] - mesh).norm(dim=-1).max())
        rows.append((names[index], round(value, 3), round(float(highest[index]), 3), round(change, 3), round(moved, 2)))
    # What training reached farthest, as a share of what is drawn, comes first.
    order = sorted(range(len(names)), key=lambda i: (-min(rows[i][2] / max(rows[i][1], 1e-6), 1), -rows[i][4], i))
    shown = [index for index in order if rows[index][1] > 0][:_SHOWN]
    pairs = []
    for index in shown:
        face = with_expression(start, index, float(start.expression[0, index]) * added + rows[index][1])
        pair = side_by_side([draw_mesh(model, face, camera), draw_avatar(avatar, face, camera)])
        pairs.append(labeled(pair, f"{names[index]} {rows[index][1]:g}"))
    films = ()
    if shown:
        write_video(context.folder / "basis.mp4", _film(context, start, shown, added), _FPS)
        films = (Film("basis.mp4", "The same expressions, one after the other, from nothing to their value and back."),)
    seen = sum(row[2] >= _WELL_SEEN * row[1] for row in rows if row[1] > 0)
    columns = ("name", "value", "largest_in_training", "picture_change", "mesh_moves_mm")
    heading = (
        "Expression",
        "Drawn at",
        "Largest in training",
        "Change of the picture, of 255",
        "Mesh moves at most, mm",
    )
    return PartResult(
        {"neutral_added": bool(added), "seen": seen, "rows": [dict(zip(columns, row, strict=True)) for row in rows]},
        (
            f"Training reached at least half of the drawn value in {seen} of {len(rows)} expressions; the others are "
            "extrapolated.",
        ),
        (Table(heading, tuple(rows[index] for index in order)),),
        pictures=(Picture("basis", picture_grid(pairs, _COLUMNS), _caption(bool(added))),) if pairs else (),
        films=films,
        notes=(
            "Each expression is drawn at 1, or at the bound of the face model if that is smaller. The other "
            + ("coefficients are those of the person at rest." if added else "coefficients are 0."),
            f"Features of this run change along {avatar.directions.shape[1]} directions of "
            f"{avatar.directions.shape[0]} inputs (--method.directions). "
            "What expressions have in common along them looks alike.",
        ),
    )


def start_of_bases(subject: FaceParams, model: FaceModel) -> tuple[FaceParams, int]:
    """The face to which single expressions are added, and 1 if it is the person at rest, or 0 if all expressions are 0.

    Coefficients that can be negative have no meaning of their own, and the person at rest is far from 0 in them. The
    supplement adds those of a neutral frame then.
    """
    if bool((model.expression_bounds[:, 0] < 0).any()):
        return subject, 1
    return replace(subject, expression=torch.zeros_like(subject.expression)), 0


def _film(context: Context, start: FaceParams, shown: list[int], added: int) -> Iterator[np.ndarray]:
    avatar, model = context.avatar, context.avatar.face_model
    camera = head_camera(model, start, context.camera, SIDE)
    for index in shown:
        top = min(1.0, float(model.expression_bounds[index, 1]))
        for frame in range(_FRAMES):
            value = top * math.sin(math.pi * frame / _FRAMES) ** 2
            face = with_expression(start, index, float(start.expression[0, index]) * added + value)
            pair = side_by_side([draw_mesh(model, face, camera), draw_avatar(avatar, face, camera)])
            yield labeled(pair, f"{model.expression_names[index]} {value:.2f}")


def _caption(added: bool) -> str:
    base = "added to the person at rest" if added else "alone"
    return f"The {_SHOWN} expressions that training reached farthest, each {base}: the mesh, and the avatar."
