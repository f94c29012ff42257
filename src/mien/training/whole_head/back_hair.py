"""Long hair behind a head: where it hangs beside the neck in the pictures, it hangs at the back as well.

The front camera sees hair beside jaw and neck, as far as it stands out from the outline, and nothing of the back. A
head whose hair ended at the hairline of the nape would lack much of its outline from the side. Long hair falls from
where the head is widest, so behind the ears it is as far from the upright axis as it is above, down to the level to
which it hangs at the sides.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.face.model import FaceModel
from mien.tracking.neck_cut import NeckParts, fit_neck_cut
from mien.training.whole_head.hair_height import HAIR_HIGHEST

_BACK_HAIR_LEAST_HEIGHT = 0.015
"""Median height at a level of jaw and neck, in metres, from which hair counts as hanging. Measured: 41 to 70 mm on two
drawn people with long hair, and 15 mm at most on those with short hair."""
_BACK_HAIR_LEAST_DISTANCE = 0.8
"""Least distance from the axis at the sides, as a share of that of the hair above, at which hair hangs."""
_BACK_HAIR_LEVEL = 0.01  # height of the levels at which the sides are looked at, in metres
_BACK_HAIR_BESIDE = 35.0
"""Angle from the sides, in degrees, within which the pictures' outline tells how far hair hangs."""
_BACK_HAIR_ALIKE = 15.0
"""Difference of angle about the axis, in degrees, within which hair above decides about hair below."""
_BACK_HAIR_MOST_FORWARD = 0.0
"""Forward part of a triangle's normal up to which it is behind. Geometry: hair in front of the shoulders is not made
up."""
_BACK_HAIR_CUT_CLEARANCE = 0.006  # least distance of hair from the cut at the neck, in metres


@torch.no_grad()
def back_hair(
    face_model: FaceModel,
    vertices: Float[Tensor, "v 3"],
    hair: Float[Tensor, " f"],
    hanging: Float[Tensor, " f"],
) -> Float[Tensor, " f"]:
    """Return the height of hair that hangs behind the head, along the triangles' normals, in metres, 0..0.08.

    It is 0 on triangles that face forward, where hair does not hang to their level, and everywhere on short hair. The
    vertices are those of the neutral head in the head frame (y up, z ahead), in metres, on the CPU. `hair` and
    `hanging` are from `hair_height` and `hanging_hair`.
    """
    middles, _, normals = triangle_geometry(vertices.detach().float(), face_model.faces.cpu())
    parts, behind_head = head_parts(face_model), torch.zeros_like(hair)
    if not bool(parts.scalp.any()) or not bool((hair > 0).any()):
        return behind_head
    scalp = middles[parts.scalp][:, [0, 2]]
    axis = (scalp.amin(0) + scalp.amax(0)) / 2
    flat, outwards = middles[:, [0, 2]] - axis, normals[:, [0, 2]]
    angle = torch.atan2(flat[:, 0], flat[:, 1])  # 0 in front, +-90 degrees at the sides
    above = flat + hair[:, None] * outwards
    widest = _widest_above(angle, middles[:, 1], above.norm(dim=1), parts.scalp)
    share = (flat + hanging[:, None] * outwards).norm(dim=1) / widest.clamp_min(1e-6)
    beside = (angle.abs() - math.pi / 2).abs() < math.radians(_BACK_HAIR_BESIDE)
    lowest = _lowest_level(beside, angle > 0, middles[:, 1], share, hanging, parts.scalp)
    if lowest is None:
        return behind_head
    behind = (parts.scalp | parts.neck | parts.skin) & (angle.abs() > math.pi / 2)
    behind &= normals[:, 2] < _BACK_HAIR_MOST_FORWARD
    behind &= middles[:, 1] >= lowest
    # The distance t along the normal to the wall of hair solves |flat + t outwards| = widest.
    a = outwards.square().sum(1).clamp_min(1e-3)
    b, c = (flat * outwards).sum(1), flat.square().sum(1) - widest.square()
    distance = (-b + (b * b - a * c).clamp_min(0).sqrt()) / a
    useful = behind & (distance > hair) & (a > 0.25)
    distance = torch.where(useful, distance, behind_head).clamp(0, HAIR_HIGHEST)
    return distance * _above_cut(face_model, vertices, middles, distance[:, None] * normals)


def _widest_above(
    angle: Float[Tensor, " f"], level: Float[Tensor, " f"], radius: Float[Tensor, " f"], scalp: Bool[Tensor, " f"]
) -> Float[Tensor, " f"]:
    """Return how far hair is from the axis at most, above each triangle and in its direction; 0 if there is none."""
    sources = scalp.nonzero()[:, 0]
    turned = (angle[:, None] - angle[sources]).abs()
    alike = torch.minimum(turned, 2 * math.pi - turned) < math.radians(_BACK_HAIR_ALIKE)
    alike &= level[sources] >= level[:, None]
    return torch.where(alike, radius[sources], 0.0).amax(1)


def _lowest_level(
    beside: Bool[Tensor, " f"],
    left: Bool[Tensor, " f"],
    level: Float[Tensor, " f"],
    share: Float[Tensor, " f"],
    hanging: Float[Tensor, " f"],
    scalp: Bool[Tensor, " f"],
) -> float | None:
    """Return the lowest level to which hair hangs without a gap at both sides; None if it does not hang at all."""
    around, lowest = beside & scalp, []
    if not bool(around.any()):
        return None
    top, step = float(level[around].amin()), _BACK_HAIR_LEVEL
    for side in (left, ~left):
        bottom = top
        while True:
            own = beside & side & ~scalp & (level < bottom) & (level >= bottom - step) & (hanging > 0)
            if not (
                bool(own.any())
                and float(hanging[own].median()) > _BACK_HAIR_LEAST_HEIGHT
                and float(share[own].median()) > _BACK_HAIR_LEAST_DISTANCE
            ):
                break
            bottom -= step
        lowest.append(bottom)
    return max(lowest) if max(lowest) < top - step / 2 else None


def _above_cut(
    face_model: FaceModel,
    vertices: Float[Tensor, "v 3"],
    middles: Float[Tensor, "f 3"],
    offsets: Float[Tensor, "f 3"],
) -> Float[Tensor, " f"]:
    """Return the largest share of each offset, 0..1, with which a point stays above the cut at the neck."""
    cut = fit_neck_cut(NeckParts.of(face_model), vertices, vertices.new_tensor([0.0, 1.0, 0.0]))
    share = torch.zeros(len(middles))
    for part in torch.linspace(0, 1, 9).tolist():
        share = torch.where(cut.margins(middles + part * offsets) > _BACK_HAIR_CUT_CLEARANCE, part, share)
    return share
