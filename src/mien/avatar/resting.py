"""The face at rest: the calmest frames, and a person with closed lips and open eyes where those have neither."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mien.face.model import FaceModel
from mien.face.params import FaceParams

_CALM, _CHOSEN = 0.3, 0.1
"""Share of the timesteps that are calm, and of those that an expression at rest is estimated from."""
_MOST_CALM = 200  # timesteps whose meshes are looked at
_LIPS = ((61, 67), (62, 66), (63, 65))
_LIDS = ((37, 41), (38, 40), (43, 47), (44, 46))
"""Landmarks of ibug68 above and below each other."""


def neutral_of(face: FaceParams) -> FaceParams:
    """The face of `face` at rest, as one timestep. A few bad frames do not change this estimate.

    The expression is the median over the tenth of the timesteps with the smallest expression coefficients, measured by
    their Euclidean norm. What remains in it belongs to the person, for example brows that the tracker always sees
    raised. Joints and head pose are the medians over all timesteps, because people mostly look towards the camera.
    """
    return _median_of(face.detach(), _calmest(face, _CHOSEN))


@torch.no_grad()
def at_rest(face: FaceParams, face_model: FaceModel) -> FaceParams:
    """`neutral_of` with closed lips and open eyes, also where the calmest frames have neither.

    Of the calm timesteps, the expression is the median over those with closed lips and open eyes. Lips that it leaves
    parted are closed: what parts them goes back by one share, as far as the face model's own lips are closed. Parted
    lips at rest would make every driven mouth too wide. For a face model without the landmarks `ibug68`, it is
    `neutral_of`.
    """
    if "ibug68" not in face_model.landmarks:
        return neutral_of(face)
    face, calm = face.detach(), _calmest(face, _CALM)
    calm = calm[:: -(-len(calm) // _MOST_CALM)]
    expressions = torch.cat([torch.zeros_like(face.expression[:1]), face.expression[calm]])
    lips, lids = _openings(face, face_model, expressions)
    # Pressed lips are no more at rest than closed ones, and wide eyes no more than half shut ones.
    parted, off = lips[1:].clamp_min(lips[0]), (lids[1:] - lids[1:].median()).abs()
    calm = calm[(_ranks(parted) + _ranks(off)).argsort(stable=True)]
    chosen = calm[: max(1, round(_CHOSEN / _CALM * len(calm)))]
    return _with_closed_lips(_median_of(face, chosen), face_model)


def _calmest(face: FaceParams, share: float) -> Int[Tensor, " c"]:
    """The timesteps with the smallest coefficients, the calmest first."""
    activity = face.expression.detach().norm(dim=-1)
    return activity.argsort(stable=True)[: max(1, round(share * len(face)))]


def _median_of(face: FaceParams, chosen: Int[Tensor, " c"]) -> FaceParams:
    """The median expression of some timesteps, with the median joints and head pose of all."""
    return replace(
        face,
        expression=face.expression[chosen].median(0, keepdim=True).values,
        joints=face.joints.median(0, keepdim=True).values,
        head_rotation=face.head_rotation.median(0, keepdim=True).values,
        head_translation=face.head_translation.median(0, keepdim=True).values,
    )


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
