"""The person at rest, with closed lips and open eyes also where the calmest frames have neither."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams

_CALM, _CHOSEN = 0.3, 0.1
"""Share of the timesteps that are calm, and of those among them that have the lips closed and the eyes open."""
_MOST_CALM = 200  # timesteps whose meshes are looked at
_LIPS = ((61, 67), (62, 66), (63, 65))
_LIDS = ((37, 41), (38, 40), (43, 47), (44, 46))
"""Landmarks of ibug68 above and below each other."""


@torch.no_grad()
def at_rest(face: FaceParams, face_model: FaceModel) -> FaceParams:
    """The person of `face` at rest, as one timestep. A few bad frames do not change this estimate.

    The expression is a median over a tenth of the timesteps: of the calm ones, those with the smallest coefficients,
    the ones with closed lips and open eyes. What remains in it belongs to the person, for example brows that the
    tracker always sees raised. Lips that it leaves parted are closed: what parts them goes back by one share, as far as
    the face model's own lips are closed. Parted lips at rest would make every driven mouth too wide. Joints and head
    pose are the medians over all timesteps, because people mostly look towards the camera.
    """
    face = face.detach()
    order = face.expression.norm(dim=-1).argsort(stable=True)
    calm = order[: max(1, round(_CALM * len(face)))]
    calm = calm[:: -(-len(calm) // _MOST_CALM)]
    if "ibug68" in face_model.landmarks:
        expressions = torch.cat([torch.zeros_like(face.expression[:1]), face.expression[calm]])
        lips, lids = _openings(face, face_model, expressions)
        # Pressed lips are no more at rest than closed ones, and wide eyes no more than half shut ones.
        parted, off = lips[1:].clamp_min(lips[0]), (lids[1:] - lids[1:].median()).abs()
        calm = calm[(_ranks(parted) + _ranks(off)).argsort(stable=True)]
    chosen = calm[: max(1, round(_CHOSEN / _CALM * len(calm)))]
    middle = replace(
        face,
        expression=face.expression[chosen].median(0, keepdim=True).values,
        joints=face.joints.median(0, keepdim=True).values,
        head_rotation=face.head_rotation.median(0, keepdim=True).values,
        head_translation=face.head_translation.median(0, keepdim=True).values,
    )
    return middle if "ibug68" not in face_model.landmarks else _with_closed_lips(middle, face_model)


def _with_closed_lips(face: FaceParams, model: FaceModel) -> FaceParams:
    """The face with what parts its lips made smaller, in 20 steps, until they are closed as in the model's neutral."""
    own = face.expression
    each = own * torch.eye(own.shape[1]).to(own)  # one coefficient at a time
    lips, _ = _openings(face, model, torch.cat([torch.zeros_like(own), each]))
    closed, parts = lips[0], (lips[1:] > lips[0] + 1e-6).to(own)
    shares = torch.linspace(0, 1, 21).to(own)[:, None]
    tried = own * (1 - shares * parts)
    enough = _openings(face, model, tried)[0] <= closed + 1e-6
    return replace(face, expression=tried[int(enough.int().argmax()) if enough.any() else -1][None])


def _openings(
    face: FaceParams, model: FaceModel, expressions: Float[Tensor, "b e"]
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """How far lips and lids are apart along the head's height, in metres, in faces whose joints are at rest."""
    joints = torch.zeros(len(expressions), *face.joints.shape[1:]).to(expressions)
    still = replace(face[[0] * len(expressions)], expression=expressions, joints=joints)
    marks = model.landmark_positions(model.head_vertices(still), "ibug68")[..., 1]
    lips, lids = (torch.stack([marks[:, up] - marks[:, low] for up, low in pairs]).mean(0) for pairs in (_LIPS, _LIDS))
    return lips, lids


def _ranks(values: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """How many values are smaller than each."""
    return torch.searchsorted(values.sort().values, values).to(values)
