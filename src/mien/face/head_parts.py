"""Triangles of a face model that are hair, skin, neck, bust, eyes and the inside of the mouth; colours of the latter.

Also, where eyes and mouth of a posed face model are in a picture.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.camera import Box, Camera
from mien.face.chart import find_outside
from mien.face.mirror import triangle_geometry
from mien.face.model import FaceModel

_MOUTH_COLOR = (0.30, 0.12, 0.11)  # colour of the mouth's lining at the lips, in daylight. These seven were set by eye
_TEETH_COLOR = (0.84, 0.80, 0.72)  # the same of teeth
_TONGUE_COLOR = (0.62, 0.34, 0.33)  # the same of the tongue
_MOUTH_FADE = 0.016  # depth in metres over which light falls to 1 / e on the mouth's lining
_TEETH_FADE = 0.030  # the same on teeth and tongue
_LIPS_DEPTH = 0.012  # depth behind the lips' front at which the inside of the mouth begins, in metres
_DARKEST_MOUTH = 0.08  # share of light that reaches the bottom of the mouth

_FACE = ("skin", "face", "nose")
_SKIN = (*_FACE, "ears", "eyelids", "eye_sockets")
_PAINTED = ("lips", "brows")


@dataclass(frozen=True, eq=False)
class HeadParts:
    """Parts of a face model. Each triangle is in exactly one of scalp, skin, painted, neck, bust, eyes and interior."""

    scalp: Bool[Tensor, " f"]
    """Where hair grows."""
    skin: Bool[Tensor, " f"]
    """Face, ears, eyelids and eye sockets."""
    face: Bool[Tensor, " f"]
    """The part of `skin` whose colour stands for skin: cheeks, chin, forehead and nose."""
    painted: tuple[Bool[Tensor, " f"], ...]
    """Lips and brows."""
    neck: Bool[Tensor, " f"]
    bust: Bool[Tensor, " f"]
    """What is below the neck, in clothes."""
    eyes: tuple[Bool[Tensor, " f"], ...]
    """The white of the eyes, and the irises."""
    mouth: Bool[Tensor, " f"]
    """The lining of the mouth."""
    teeth: Bool[Tensor, " f"]
    tongue: Bool[Tensor, " f"]
    front: float
    """Depth coordinate (z) of the lips' front in the template, in metres."""

    @property
    def interior(self) -> Bool[Tensor, " f"]:
        """Everything inside the mouth."""
        return self.mouth | self.teeth | self.tongue

    def kinds(self) -> list[tuple[Bool[Tensor, " f"], Bool[Tensor, " f"]]]:
        """Return parts that are coloured alike, each with the triangles that its colours may spread from."""
        near_neck = self.neck | self.skin
        return [
            (self.scalp, self.scalp),
            (self.skin, self.skin),
            (self.neck, near_neck),
            (self.bust, self.bust),
            *((part, part) for part in (*self.painted, *self.eyes)),
        ]


def head_parts(face_model: FaceModel) -> HeadParts:
    """Return the parts of a face model: by its regions, and by position for regions that it lacks."""
    middles, _, _ = triangle_geometry(face_model.template.cpu().float(), face_model.faces.cpu())

    def region(*names: str) -> Tensor:
        return face_model.region_mask(*names).cpu()

    eyes, irises = region("eyes"), region("irises")
    teeth, tongue, mouth = region("teeth"), region("tongue"), region("mouth")
    neck, bust = region("neck"), region("bust")
    free = ~(eyes | irises | teeth | tongue | mouth | neck | bust)
    if not bool(mouth.any()):
        mouth = free & _inside_mouth(face_model, middles)
        free = free & ~mouth
    scalp = region("scalp") if bool(region("scalp").any()) else free & _above_hairline(middles)
    painted = tuple(region(name) & free & ~scalp for name in _PAINTED)
    skin = free & ~scalp & ~torch.stack(painted).any(0)
    lips = region("lips")
    front = middles[lips if bool(lips.any()) else skin, 2].max() if bool(skin.any()) else middles[:, 2].max()
    face = region(*_FACE) & skin
    return HeadParts(scalp, skin, face, painted, neck, bust, (eyes, irises), mouth, teeth, tongue, float(front))


def _above_hairline(middles: Float[Tensor, "f 3"]) -> Bool[Tensor, " f"]:
    """Return the triangles above a slanted plane over temples and nape and a level one over the forehead, without ears.

    The eyes are at a height of about 0 and a depth of 0.08 m in every face model's head frame.
    """
    x, y, z = middles.unbind(1)
    ears = (x.abs() > 0.062) & (y > -0.06) & (y < 0.015) & (z > -0.03) & (z < 0.03)
    return ((0.55 * (y - 0.026) > z - 0.073) & (y > -0.08) | (y > 0.054)) & ~ears


def _inside_mouth(face_model: FaceModel, middles: Float[Tensor, "f 3"]) -> Bool[Tensor, " f"]:
    """Return the hidden triangles near the mouth of a model without a region for them."""
    outside = find_outside(face_model.template.cpu().numpy(), face_model.faces.cpu().numpy())
    x, y, z = middles.unbind(1)
    near = (x.abs() < 0.042) & (y > -0.12) & (y < -0.03) & (z > -0.01)
    return torch.from_numpy(~outside) & near


def mouth_colors(parts: HeadParts, middles: Float[Tensor, "f 3"]) -> Float[Tensor, "f 3"]:
    """Return colours for the inside of a mouth in daylight, which get darker with the depth behind the lips.

    They are meaningful where `parts.interior` is true. Teeth stay lighter than what surrounds them.

    `middles` are those of the triangles of the neutral head, in metres.
    """
    depth = (parts.front - _LIPS_DEPTH - middles[:, 2:3]).clamp_min(0)
    fade = torch.where(parts.mouth[:, None], _MOUTH_FADE, _TEETH_FADE)
    light = torch.exp(-depth / fade).clamp_min(_DARKEST_MOUTH)
    colors = middles.new_tensor(_MOUTH_COLOR).expand_as(middles)
    for part, color in ((parts.teeth, _TEETH_COLOR), (parts.tongue, _TONGUE_COLOR)):
        colors = torch.where(part[:, None], middles.new_tensor(color), colors)
    return colors * light


_EYES_MARGIN = 0.12  # margin around the eyes' regions on each side, relative to the width of the part. Set by eye
_MOUTH_MARGIN = 0.2  # the same around the mouth. Set by eye
_PART_LEAST_COSINE = 0.3
"""Smallest cosine between the direction from the head's middle to the part and that from the part to the camera at
which the part counts as seen."""
_PART_LEAST_SIDE = 8  # smallest side of a part's box, in pixels. Smaller parts show nothing

PARTS = ("eyes", "mouth")
"""Names of the parts. The eyes are one part."""
_PART_REGIONS = {"eyes": ("eyelids", "eyes", "irises"), "mouth": ("lips",)}
"""Regions of the face model inside each part. Teeth show only between the lips."""


def part_boxes(face_model: FaceModel, vertices: Float[Tensor, "v 3"], camera: Camera) -> dict[str, Box]:
    """The boxes of the parts that a camera sees, by name, with a margin, cut at the picture's border.

    A part is missing if it faces away from the camera, if less than half of its box is inside the picture, if it is
    smaller than 8 pixels, or if the face model has none of its regions.

    The face model is on the CPU, and its vertices are in world space, in metres.
    """
    margins: dict[str, float] = {"eyes": _EYES_MARGIN, "mouth": _MOUTH_MARGIN}
    found: dict[str, Box] = {}
    for name in PARTS:
        triangles = face_model.faces[face_model.region_mask(*_PART_REGIONS[name])]
        box = _box_of(vertices, triangles, camera, margins[name]) if len(triangles) else None
        if box is not None:
            found[name] = box
    return found


def _box_of(vertices: Float[Tensor, "v 3"], triangles: Tensor, camera: Camera, margin: float) -> Box | None:
    corners = vertices[triangles]
    points, depth = camera.project(corners.reshape(-1, 3))
    middle = corners.reshape(-1, 3).mean(0)
    outward, towards = middle - (vertices.amin(0) + vertices.amax(0)) / 2, camera.position - middle
    if not (depth > 0).all() or not torch.isfinite(points).all():
        return None
    if float((outward * towards).sum()) < _PART_LEAST_COSINE * float(outward.norm() * towards.norm()):
        return None
    low, high = points.amin(0), points.amax(0)
    beyond = margin * (high[0] - low[0])
    ends = [round(float(value)) for value in (*(low - beyond), *(high + beyond))]
    left, top = max(ends[0], 0), max(ends[1], 0)
    right, bottom = min(ends[2], camera.width), min(ends[3], camera.height)
    width, height = max(right - left, 0), max(bottom - top, 0)
    if min(width, height) < _PART_LEAST_SIDE or 2 * width * height < (ends[2] - ends[0]) * (ends[3] - ends[1]):
        return None
    return left, top, width, height
