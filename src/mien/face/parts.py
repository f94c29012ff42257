"""Where eyes and mouth of a posed face model are in a picture."""

import torch
from jaxtyping import Float
from torch import Tensor

from mien.camera import Box, Camera
from mien.face.model import FaceModel

_EYES_MARGIN = 0.12  # margin around the eyes' regions on each side, relative to the width of the part. Set by eye
_MOUTH_MARGIN = 0.2  # the same around the mouth. Set by eye
_PART_LEAST_COSINE = 0.3
"""Smallest cosine between the direction from the head's middle to the part and that from the part to the camera at
which the part counts as seen."""
_PART_LEAST_SIDE = 8  # smallest side of a part's box, in pixels. Smaller parts show nothing

PARTS = ("eyes", "mouth")
"""Names of the parts. The eyes are one part."""
_REGIONS = {"eyes": ("eyelids", "eyes", "irises"), "mouth": ("lips",)}
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
        triangles = face_model.faces[face_model.region_mask(*_REGIONS[name])]
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
