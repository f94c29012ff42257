"""One expression beyond its largest training value, and the camera beyond its training views (Fig. 3)."""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from mien.camera import Camera
from mien.lab.analysis.context import Context
from mien.lab.analysis.headgas.trained import Trained, trained_range, with_expression
from mien.lab.analysis.result import Chart, Film, PartResult, Picture
from mien.lab.analysis.views import draw_avatar, draw_mesh, head_camera, labeled
from mien.media.pictures import picture_grid, side_by_side
from mien.media.video import write_video
from mien.pages.plots import Axes, Series
from mien.render.camera_paths import turned_camera

_REACH = 1.4
"""Largest multiple of the training maximum: the supplement's own."""
_FACTORS = (0.0, 0.5, 1.0, 1.1, 1.2, 1.3, 1.4)
_FARTHER = (30.0, 15.0)
"""How far pictures go beyond the training views on each side, in degrees."""
SIDE = 224
"""Width and height of a picture, in pixels."""
_FRAMES, _FPS = 60, 25


def beyond(context: Context) -> PartResult:
    """The avatar with one expression to 1.4 times its training maximum, and from views beyond those of training."""
    trained, model = trained_range(context), context.avatar.face_model
    index = strongest_expression(context, trained)
    name, most = model.expression_names[index], float(trained.highest[index])
    yaws = shown_yaws(trained)
    expressions = [_pair(context, index, factor * most) for factor in _FACTORS]
    rows = [
        labeled(picture, f"{factor:g} x largest") for factor, (picture, _) in zip(_FACTORS, expressions, strict=True)
    ]
    meshes = [labeled(mesh, "") for _, mesh in expressions]
    views = [labeled(_seen_from(context, trained, yaw), f"{math.degrees(yaw):+.0f} degrees") for yaw in yaws]
    write_video(context.folder / "beyond-expression.mp4", _expression_film(context, index, most), _FPS)
    write_video(context.folder / "beyond-view.mp4", _view_film(context, trained), _FPS)
    low, high = (math.degrees(yaw) for yaw in trained.yaws)
    factors, changes = _changes(context, index, most)
    inside, outside = (float(changes[part].mean()) for part in (factors <= 1.001, factors > 1.001))
    return PartResult(
        {
            "expression": name,
            "largest_in_training": round(most, 4),
            "factors": factors.round(2).tolist(),
            "picture_change": changes.round(4).tolist(),
            "training_yaw_degrees": [round(low, 1), round(high, 1)],
            "shown_yaw_degrees": [round(math.degrees(yaw), 1) for yaw in yaws],
        },
        (
            f"From 1 to {_REACH:g} times the largest training value of {name}, a tenth more changes the picture by "
            f"{outside:.2f} of 255 on average, and {inside:.2f} below. The supplement sees colours deteriorate from "
            "1.2 times on.",
            f"Training saw the head from {low:.0f} to {high:.0f} degrees (yaw, positive to the subject's left). "
            f"Pictures go {_FARTHER[0]:.0f} degrees farther on both sides.",
        ),
        charts=(
            Chart(
                "beyond-change",
                f"Change of the picture by a tenth more of {name}",
                (Series("this run", factors, changes),),
                Axes(
                    "times the largest training value", "mean change, of 255", from_zero=True, shaded=((1.0, _REACH),)
                ),
                "Shaded: what training did not see.",
            ),
        ),
        pictures=(
            Picture("beyond-expression", picture_grid([*rows, *meshes], len(rows)), f"{name}, and the mesh below."),
            Picture("beyond-view", side_by_side(views), "The person at rest; the outer two on each side are unseen."),
        ),
        films=(
            Film("beyond-expression.mp4", f"{name} from 0 to {_REACH:g} times its largest training value."),
            Film("beyond-view.mp4", "The camera from one side to the other, beyond the training views on both."),
        ),
        notes=("`mien render --set` refuses such values for users; this part poses the avatar itself.",),
    )


def strongest_expression(context: Context, trained: Trained) -> int:
    """The expression that moves the mesh most at its largest training value."""
    basis = context.avatar.face_model.expression_basis
    return int((trained.highest.clamp_min(0) * basis.flatten(1).norm(dim=-1)).argmax())


def shown_yaws(trained: Trained) -> list[float]:
    """Yaws of the pictures in radians, lowest first: beyond the training views, at their ends, and in the middle."""
    low, high = trained.yaws
    farther = [math.radians(angle) for angle in _FARTHER]
    return [*(low - angle for angle in farther), low, 0.5 * (low + high), high, *(high + a for a in reversed(farther))]


def _pair(context: Context, index: int, value: float) -> tuple[np.ndarray, np.ndarray]:
    avatar, model = context.avatar, context.avatar.face_model
    camera = head_camera(model, avatar.subject, context.camera, SIDE)
    face = with_expression(avatar.subject, index, value)
    return draw_avatar(avatar, face, camera), draw_mesh(model, face, camera)


def _changes(context: Context, index: int, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Factors, and the mean change of the picture from a tenth less to each of them, of 255."""
    factors = np.arange(0, round(10 * _REACH) + 1) / 10
    drawn = [_pair(context, index, factor * most)[0].astype(np.float32) for factor in factors]
    return factors[1:], np.array([float(np.abs(second - first).mean()) for first, second in pairwise(drawn)])


def view_from(context: Context, trained: Trained, yaw: float) -> Camera:
    """The camera, moved around the person at rest until the head sees it at this yaw, in radians."""
    avatar = context.avatar
    camera = head_camera(avatar.face_model, avatar.subject, context.camera, SIDE)
    return turned_camera(camera, avatar.subject.head_translation[0], yaw - trained.yaw_at_rest, 0.0)


def _seen_from(context: Context, trained: Trained, yaw: float) -> np.ndarray:
    return draw_avatar(context.avatar, context.avatar.subject, view_from(context, trained, yaw))


def _expression_film(context: Context, index: int, most: float) -> Iterator[np.ndarray]:
    for frame in range(_FRAMES):
        factor = _REACH * frame / (_FRAMES - 1)
        yield labeled(side_by_side(_pair(context, index, factor * most)), f"{factor:.2f} x largest")


def _view_film(context: Context, trained: Trained) -> Iterator[np.ndarray]:
    first, *_, last = shown_yaws(trained)
    for frame in range(_FRAMES):
        yaw = first + (last - first) * frame / (_FRAMES - 1)
        inside = trained.yaws[0] <= yaw <= trained.yaws[1]
        text = f"{math.degrees(yaw):+.0f} degrees, {'seen' if inside else 'unseen'}"
        yield labeled(_seen_from(context, trained, yaw), text)
