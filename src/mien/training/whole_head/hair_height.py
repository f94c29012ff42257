"""How far hair is off a face model, measured on the outlines of the mattes, and long hair behind a head.

The front camera sees hair beside jaw and neck, as far as it is beyond the outline, and nothing of the back. A
head whose hair ended at the hairline of the nape would lack much of its outline from the side. Long hair falls from
where the head is widest, so behind the ears it is as far from the upright axis as it is above, down to the level to
which it hangs at the sides.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mien.face.head_parts import head_parts
from mien.face.mirror import triangle_geometry
from mien.face.model import FaceModel
from mien.machine.parallel import stream_in_threads
from mien.render.mesh import rasterize_mesh
from mien.tracking.neck_cut import NeckParts, fit_neck_cut
from mien.training.footage.frames import Footage, Frame, spread_frames
from mien.training.whole_head.completion import Surface

_HAIR_FRAMES = 60  # number of evenly spread frames whose outlines are measured
_HAIR_STEP = 0.002  # distance between the points that are tested above the scalp, in metres
HAIR_HIGHEST = 0.08  # largest height of hair that counts, in metres
_HAIR_GRAZING = 0.4
"""Cosine between a triangle's normal and the direction to the camera up to which the outline tells its height."""
_HAIR_OUTLINE_CLEARANCE = 0.008
"""Height in metres at which nothing of the mesh may be behind or in front of a triangle at the outline."""
_HAIR_QUANTILE = 0.3
"""Share of the measured heights below the one that counts. Single strands and other things behind make some higher.
Measured: 0.2 is as good on short hair, and 0.3 dB worse at 15 degrees on long hair (log, 11-24)."""
_HAIR_GUESS_LIMIT = 1.3
"""Largest height where nothing was measured, as a multiple of the median height on top of the head. Measured against no
limit on three drawn people: short hair loses up to .005 of overlap, long hair gains .012 to .018."""
_HAIR_SLOPE = 0.12
"""Difference of slope (the upward part of a normal) within which measured heights count alike for what is never
measured. Chosen with the rule (log, 11-24) alone."""
_HAIR_SLOPE_DISTANCE = 0.03  # distance in metres within which they do. Chosen with the rule alone
_HAIRLINE_HEIGHT = 0.004  # largest height in metres at the hairline where nothing was measured
_HAIRLINE_RISE = 0.4  # how much this height grows per metre from skin. Chosen with the rule alone
_HAIR_SMOOTHING_ROUNDS = 2
"""Rings of triangles over which heights are averaged. Measured: 80 flatten the hair on top (3.3 instead of 2.6 mm of
error; log, 11-24)."""
_HAIRLINE_FADING_ROUNDS = 2
"""Rings of triangles over which the height fades at the hairline. Chosen with the smoothing, instead of 6."""
_HANGING_HAIR_ROUNDS = 4  # rings of triangles around an outline that hanging hair may cover too


@torch.no_grad()
def hair_height(footage: Footage) -> Float[Tensor, " f"]:
    """Return the height of hair above each triangle along its normal, in metres, 0..0.08; 0 outside of the scalp.

    A triangle of the scalp is measured in frames in which it is on the outline of the mesh: its height is the distance
    along its normal to the border of the matte. Triangles that are never on the outline have the height of what was
    measured where the head is as steep. Near skin, ears included, they have no more than hair that rises slowly from
    the hairline, where the height fades. Without any measurement it is 0.
    """
    face_model, parts = footage.face_model, head_parts(footage.face_model)
    scalp = parts.scalp
    height, known = _outline_heights(footage, scalp)
    if not bool(known.any()):
        return height[:, 0]
    vertices = face_model.rest_vertices(footage.faces[0])
    surface, upward = Surface.of(vertices, face_model.faces), triangle_geometry(vertices, face_model.faces)[2][:, 1]
    most = _HAIR_GUESS_LIMIT * _on_top(surface, height, known)
    guess = _by_slope(surface, upward, height, known, scalp).clamp_max(most)
    guess[scalp, 0] = guess[scalp, 0].minimum(_behind_hairline(surface, scalp, parts.skin))
    height = torch.lerp(guess, height, known[:, None])
    inside = scalp.to(height)
    for _ in range(_HAIR_SMOOTHING_ROUNDS):
        height = surface.around(height, inside) * inside[:, None]
    share = inside[:, None]
    for _ in range(_HAIRLINE_FADING_ROUNDS):
        share = torch.minimum(share, surface.around(share, torch.ones_like(known))) * inside[:, None]
    return (height * share)[:, 0].clamp(0, HAIR_HIGHEST)


@torch.no_grad()
def hanging_hair(footage: Footage) -> Float[Tensor, " f"]:
    """Return how far the outline is beyond the mesh beside skin and neck, in metres, 0..0.08; 0 on the scalp.

    Long hair hangs off the scalp, beside cheeks and neck, and rings hang from ears. Unlike `hair_height`, nothing is
    concluded about triangles that are far from any outline.
    """
    face_model, parts = footage.face_model, head_parts(footage.face_model)
    beside = parts.skin | parts.neck
    height, known = _outline_heights(footage, beside)
    if not bool(known.any()):
        return height[:, 0]
    surface = Surface.of(face_model.rest_vertices(footage.faces[0]), face_model.faces)
    for _ in range(_HANGING_HAIR_ROUNDS):
        height = torch.maximum(height, surface.around(height, torch.ones_like(known)))
        height[~beside] = 0
    return height[:, 0].clamp(0, HAIR_HIGHEST)


def _outline_heights(footage: Footage, region: Bool[Tensor, " f"]) -> tuple[Float[Tensor, "f 1"], Float[Tensor, " f"]]:
    """Return the height of the outline above the triangles of a region, and how sure it is, 0..1; 0 elsewhere."""
    chosen, used = region.nonzero()[:, 0], spread_frames(footage.frames, _HAIR_FRAMES)
    measured = list(stream_in_threads(lambda frame: _measured(footage, frame, chosen), used))
    heights = torch.stack(measured) if used else torch.zeros(0, len(chosen))
    height, known = torch.zeros(len(region), 1), torch.zeros(len(region))
    found = heights.isfinite().any(0)
    if bool(found.any()):
        height[chosen[found], 0] = heights[:, found].nanquantile(_HAIR_QUANTILE, dim=0)
        known[chosen[found]] = heights.isfinite().sum(0)[found].clamp_max(3) / 3
    return height, known


def _on_top(surface: Surface, height: Float[Tensor, "f 1"], known: Float[Tensor, " f"]) -> float:
    """Return the median height in the upper half of what was measured. Lower down, long hair hangs off the head."""
    measured = known > 0
    level = surface.middles[measured, 1].median()
    return float(height[measured & (surface.middles[:, 1] >= level)].median())


def _by_slope(
    surface: Surface,
    upward: Float[Tensor, " f"],
    height: Float[Tensor, "f 1"],
    known: Float[Tensor, " f"],
    among: Bool[Tensor, " f"],
) -> Float[Tensor, "f 1"]:
    """Return the mean of the measured heights where the head is as steep, most of all of the near ones.

    Hair is short on the walls of a head and long where it curves to the top, behind as at the sides. `upward` is the
    upward part of the triangles' normals.
    """
    targets, sources = among.nonzero()[:, 0], (known > 0).nonzero()[:, 0]
    apart = surface.middles[targets, None] - surface.middles[sources]
    alike = torch.exp(-0.5 * ((upward[targets, None] - upward[sources]) / _HAIR_SLOPE).square()) + 1e-9
    weight = alike * known[sources] / (apart.square().sum(-1) + _HAIR_SLOPE_DISTANCE**2)
    guess = torch.zeros_like(height)
    guess[targets, 0] = (weight * height[sources, 0]).sum(1) / weight.sum(1)
    return guess


def _behind_hairline(surface: Surface, scalp: Bool[Tensor, " f"], skin: Bool[Tensor, " f"]) -> Float[Tensor, " k"]:
    """Return the largest height of hair on each triangle of the scalp. Hair over a forehead grows out of the skin."""
    if not bool(skin.any()):
        return surface.middles.new_full((int(scalp.sum()),), HAIR_HIGHEST)
    from_scalp, to_skin = surface.middles[scalp], surface.middles[skin]
    apart = torch.cdist(from_scalp, to_skin, compute_mode="donot_use_mm_for_euclid_dist")
    return _HAIRLINE_HEIGHT + _HAIRLINE_RISE * apart.amin(1)


def _measured(footage: Footage, frame: Frame, chosen: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the height of the matte's border above some triangles in one frame; NaN where the frame does not tell."""
    vertices, faces, camera = footage.vertices(frame), footage.face_model.faces, footage.camera(frame)
    matte = torch.from_numpy(footage.matte(frame).astype(np.float32)) / 255
    empty = rasterize_mesh(vertices, faces, camera).face_index < 0
    middles, _, normals = (values[chosen] for values in triangle_geometry(vertices, faces))
    cosine = (normals * normalize(camera.position - middles, dim=-1)).sum(-1)
    step = _HAIR_STEP
    steps = torch.arange(0.0, HAIR_HIGHEST + step / 2, step)
    pixels, depth = camera.project(middles[:, None] + steps[:, None] * normals[:, None])
    grid = pixels / torch.tensor([camera.width, camera.height]) * 2 - 1
    inside = _sample(matte, grid) > 0.5
    framed = (grid.abs() < 1).all(-1) & (depth > 0)
    aside = round(_HAIR_OUTLINE_CLEARANCE / step)
    clear = _sample(empty.float(), grid[:, aside:][:, :1])[:, 0] > 0.5
    count = inside.int().cumprod(1).sum(1)
    ends = (count < len(steps)) & framed.all(1)
    tells = (cosine.abs() < _HAIR_GRAZING) & clear & ends
    height = step * (count - 1).clamp_min(0).float()
    return torch.where(tells, height, torch.nan)


def _sample(picture: Float[Tensor, "h w"], grid: Float[Tensor, "n s 2"]) -> Float[Tensor, "n s"]:
    return grid_sample(picture[None, None], grid.nan_to_num(2.0).clamp(-2, 2)[None], align_corners=False)[0, 0]


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
