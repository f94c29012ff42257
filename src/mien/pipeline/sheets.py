"""Sheets: many pictures of an avatar in one, each above its name."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from mien.camera import Camera
from mien.driving.motion import ARKIT_NAMES
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.media.pictures import WHITE, picture_grid
from mien.pipeline.expression import with_expression
from mien.render.camera_paths import orbit
from mien.runtime.baked import Filmed
from mien.runtime.camera_paths import zoom_for_all
from mien.runtime.named import GAZE_NAMES, is_gaze, presets_for, turned_eyes

TURNTABLE_TILES = 9
"""Number of angles on a sheet of a turntable."""
MAX_TILES = 120
"""Largest number of expressions on a sheet. Face models with more show the first ones."""
SMALL_TILE = 288
"""Width and height of the pictures on a sheet of expressions without --size, in pixels."""


@dataclass(frozen=True, eq=False)
class Tile:
    """One picture of a sheet."""

    name: str
    face: FaceParams
    camera: Camera


def expression_tiles(model: FaceModel, face: FaceParams, camera: Camera, strength: float) -> list[Tile]:
    """The face as given, then one tile for each named expression at `strength`, within the bounds of the face model.

    A model with ARKit's expressions shows them in ARKit's order. Those of the gaze turn the eyes. Expressions that the
    model cannot show are left out.
    """
    tiles, joints = [Tile("as it is", face, camera)], face.joints
    named = [name for name in ARKIT_NAMES if name in model.expression_names]
    for name in named or model.expression_names:
        if name in GAZE_NAMES:
            if is_gaze(name, model.free_joint_names):
                turned = turned_eyes(joints.detach().cpu().numpy(), model.free_joint_names, {name: strength})
                looking = replace(face, joints=torch.from_numpy(turned).to(joints))
                tiles.append(Tile(f"{name} {strength:.2f}", looking, camera))
            continue
        lower, upper = model.expression_bounds[model.expression_names.index(name)].tolist()
        value = min(max(strength, lower), upper)
        if lower < upper:
            tiles.append(Tile(f"{name} {value:.2f}", _with(face, model, name, value), camera))
    return tiles[: MAX_TILES + 1]


def filmed_tiles(model: FaceModel, face: FaceParams, camera: Camera, filmed: Filmed, strength: float) -> list[Tile]:
    """The face as given, then each expression at `strength` times its largest filmed coefficient, strongest first.

    Coefficients stay within the bounds of the face model. Expressions that it cannot show are left out.
    """
    tiles = [Tile("as it is", face, camera)]
    highest = filmed.highest[: len(model.expression_names)]
    for index in np.argsort(-highest, kind="stable").tolist()[:MAX_TILES]:
        lower, upper = model.expression_bounds[index].tolist()
        value = min(max(strength * float(highest[index]), lower), upper)
        if lower < upper:
            name = model.expression_names[index]
            tiles.append(Tile(f"{name} {value:.2f}", _with(face, model, name, value), camera))
    return tiles


def preset_tiles(
    model: FaceModel, face: FaceParams, camera: Camera, center: Float[Tensor, " 3"], filmed: Filmed
) -> list[Tile]:
    """The face as given and the preset faces of pages, first as the camera sees them, then from 20 degrees aside."""
    faces = {"as it is": face}
    faces |= {
        name.replace("_", " "): with_expression(face, model, (f"{name}=1",), filmed)
        for name in presets_for(model.expression_names, model.free_joint_names)
    }
    sides = {"": camera, ", aside": orbit(camera, center, math.radians(20))}
    return [Tile(f"{name}{side}", own, seen) for side, seen in sides.items() for name, own in faces.items()]


def turntable_tiles(face: FaceParams, camera: Camera, center: Float[Tensor, " 3"], degrees: float) -> list[Tile]:
    """The face from `TURNTABLE_TILES` sides, from the person's right to the left, `degrees` apart from end to end.

    A full turn does not show its first side again.
    """
    gaps = TURNTABLE_TILES if abs(degrees) >= 360 else TURNTABLE_TILES - 1
    angles = [degrees * (index / gaps - 0.5) for index in range(TURNTABLE_TILES)]
    names = [f"{angle:+.0f} degrees" if round(angle) else "as filmed" for angle in angles]
    cameras = [orbit(camera, center, math.radians(angle)) for angle in angles]
    return [Tile(name, face, camera) for name, camera in zip(names, cameras, strict=True)]


def nearer_tiles(
    tiles: Sequence[Tile],
    picture: Callable[[FaceParams, Camera], UInt8[np.ndarray, "h w 3"]],
    background: tuple[int, int, int],
) -> list[Tile]:
    """The same tiles, magnified alike so that what they show fills them but for a margin of 4 %.

    They are made smaller only where the filmed frame cuts the head off. Pictures of a quarter of the size tell where it
    is: a pixel belongs to it that differs from the background by more than 24 of 255.
    """
    first = tiles[0].camera
    width, height = (max(1, round(side / 4)) for side in (first.width, first.height))

    def drawn(zoom: float) -> Bool[np.ndarray, "h w"]:
        glances = [picture(tile.face, tile.camera.fitted(width, height, zoom)) for tile in tiles]
        return np.any([np.abs(one.astype(int) - background).max(-1) > 24 for one in glances], axis=0)

    zoom = zoom_for_all(drawn)
    shown = drawn(zoom)
    if zoom < 1:
        tiles = [replace(tile, camera=tile.camera.fitted(first.width, first.height, zoom)) for tile in tiles]
    left, top, wide, high = cv2.boundingRect(shown.astype(np.uint8))
    if not wide:
        return list(tiles)
    scale = max(1.0, (1 - 2 * 0.04) * min(width / wide, height / high))

    def shift(center: float, side: int) -> float:
        """The shift of a magnified picture along one side, such that nothing beyond the picture is shown."""
        half = side / scale / 2
        return scale * (min(max(center * side, half), side - half) - side / 2)

    x = shift((left + wide / 2) / width, first.width)
    y = shift((top + high / 2) / height, first.height)
    size = first.width, first.height
    return [replace(tile, camera=tile.camera.fitted(*size, scale).cropped(x, y, *size)) for tile in tiles]


def draw_sheet(
    tiles: Sequence[Tile],
    picture: Callable[[FaceParams, Camera], UInt8[np.ndarray, "h w 3"]],
    background: tuple[int, int, int] = (WHITE, WHITE, WHITE),
) -> UInt8[np.ndarray, "_ _ 3"]:
    """All tiles in rows as even as possible, each above its name, in a sheet of several columns below 1,800 pixels."""
    named = [named_picture(picture(tile.face, tile.camera), tile.name, background) for tile in tiles]
    gap = 4
    most = max((1800 + gap) // (named[0].shape[1] + gap), 1)
    rows = math.ceil(len(named) / most)
    return picture_grid(named, math.ceil(len(named) / rows), gap, background)


def named_picture(
    picture: UInt8[np.ndarray, "h w 3"], name: str, background: tuple[int, int, int] = (WHITE, WHITE, WHITE)
) -> UInt8[np.ndarray, "_ w 3"]:
    """A picture with its name below, in letters that fit the picture's size. A name that is too wide is smaller."""
    wide, font = picture.shape[1], cv2.FONT_HERSHEY_SIMPLEX
    high = max(22, round(0.09 * wide))
    bar = np.full((high, wide, 3), background, np.uint8)
    size, thick = 0.021 * high, max(1, round(high / 24))
    (length, _), _ = cv2.getTextSize(name, font, size, thick)
    size *= min(1.0, (wide - 8) / max(length, 1))
    ink = (40, 40, 40) if sum(background) > 3 * WHITE / 2 else (225, 225, 225)
    cv2.putText(bar, name, (4, round(0.68 * high)), font, size, ink, thick, cv2.LINE_AA)
    return np.concatenate([picture, bar])


def _with(face: FaceParams, model: FaceModel, name: str, value: float) -> FaceParams:
    expression = face.expression.clone()
    expression[:, model.expression_names.index(name)] = value
    return replace(face, expression=expression)
