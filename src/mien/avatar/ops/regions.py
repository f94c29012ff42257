"""Regions of a face, and how their vertices move, so that Gaussians change with the motion around them."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.runtime.torso import TORSO, TORSO_SHIFTS

_STEP = 0.1
"""Change of an input for differences, in its unit."""
_BROW, _BROW_BLEND, _EYE, _EYE_BLEND = 0.55, 0.4, -0.75, 0.6
"""Borders below brows and eyes, and the widths over which regions blend there: heights above the eyes' centres, in
units of the distance from there to the brows."""
_FACE, _FACE_BLEND = 0.95, 0.2
"""Border of the face, and the width over which it blends with what is around it: in units of a rounded rectangle, as
wide as the ears' landmarks, as high as from the chin to `_TOP` above the brows, in units of the same distance."""
_TOP = 1.2
_MIDDLE_BLEND = 0.25  # width over which left and right blend, in units of the distance between the eyes' outer corners


def region_shares(face_model: FaceModel, subject: FaceParams) -> Float[Tensor, "v g"]:
    """Shares of regions in vertices at rest, with a sum of 1.

    The regions are brows and eyes, left and right, the lower face with the neck, the mouth's inside, which its own
    motion alone changes, and the rest, which no expression moves: hair, scalp and ears. A model without the landmarks
    `ibug68` is one region.
    """
    vertices = face_model.head_vertices(subject)[0]
    if "ibug68" not in face_model.landmarks:
        return torch.ones_like(vertices[:, :1])
    marks = face_model.landmark_positions(vertices, "ibug68")
    eyes = marks[36:48, 1].mean()
    gap = marks[17:27, 1].mean() - eyes
    brows = _smooth_step(vertices[:, 1], eyes + _BROW * gap, _BROW_BLEND * gap)
    upper = _smooth_step(vertices[:, 1], eyes + _EYE * gap, _EYE_BLEND * gap)
    width = _MIDDLE_BLEND * (marks[45, 0] - marks[36, 0]).abs()
    left = _smooth_step(vertices[:, 0], marks[27:31, 0].mean(), width)
    sides = torch.stack([left, 1 - left], 1)
    turning = [index for index, name in enumerate(face_model.joint_names) if "eye" in name]
    brows = brows * (1 - face_model.skinning_weights[:, turning].sum(1))  # eyeballs reach up behind the brows
    brow, eye = upper * brows, upper * (1 - brows)
    parts = torch.cat([brow[:, None] * sides, eye[:, None] * sides, 1 - upper[:, None]], 1)
    chin, top = marks[8, 1], eyes + (1 + _TOP) * gap
    wide, high = (marks[16, 0] - marks[0, 0]).abs() / 2, (top - chin) / 2
    middle = torch.stack([marks[[0, 16], 0].mean(), (top + chin) / 2])
    away = ((vertices[:, :2] - middle) / torch.stack([wide, high])).norm(p=4, dim=1)
    behind = _smooth_step(marks[[0, 16], 2].mean() - vertices[:, 2], torch.zeros(()).to(wide), _FACE_BLEND * wide)
    around = torch.maximum(_smooth_step(away, torch.tensor(_FACE).to(wide), torch.tensor(_FACE_BLEND).to(wide)), behind)
    around = around * _smooth_step(vertices[:, 1], chin, _FACE_BLEND * high)
    inside = _share_of_triangles(face_model, "teeth", "tongue", "mouth")[:, None]
    face = torch.cat([parts * (1 - around[:, None]), 0 * inside, around[:, None]], 1)
    return face * (1 - inside) + inside * torch.eye(7)[5].to(inside)


def _share_of_triangles(face_model: FaceModel, *names: str) -> Float[Tensor, " v"]:
    """The share of each vertex' triangles that belong to some of the model's own regions."""
    corners, chosen = face_model.faces.long(), face_model.region_mask(*names).to(face_model.template)
    vertices = face_model.template.new_zeros(len(face_model.template), 2)
    for corner in corners.unbind(1):
        vertices.index_add_(0, corner, torch.stack([chosen, torch.ones_like(chosen)], 1))
    return vertices[:, 0] / vertices[:, 1].clamp_min(1)


@torch.no_grad()
def vertex_motions(face_model: FaceModel, subject: FaceParams) -> Float[Tensor, "i v 3"]:
    """How the vertices move with each input of the face, in metres per unit, around the person at rest.

    Neck and torso count as still: they turn and shift all below the chin, as the head's pose does.
    """
    e, j = subject.expression.shape[1], subject.joints.shape[1]
    i = e + 3 * j
    many = subject[[0] * i]

    def at(change: Float[Tensor, "i i"]) -> Float[Tensor, "i v 3"]:
        joints = many.joints + change[:, e:].reshape(i, j, 3)
        return face_model.head_vertices(replace(many, expression=many.expression + change[:, :e], joints=joints))

    steps = _STEP * torch.eye(i).to(subject.expression)
    motions = (at(steps) - at(-steps)) / (2 * _STEP)
    for joint, name in enumerate(face_model.free_joint_names):
        if name in ("neck", TORSO):
            motions[e + 3 * joint : e + 3 * joint + 3] = 0
    for index, name in enumerate(face_model.expression_names):
        if name in TORSO_SHIFTS:
            motions[index] = 0
    return motions


def _smooth_step(values: Tensor, middle: Tensor, width: Tensor) -> Tensor:
    t = ((values - middle) / width + 0.5).clamp(0, 1)
    return t * t * (3 - 2 * t)
