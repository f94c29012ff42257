"""Glasses: what does not bend with a face, although its Gaussians are bound to brows, lids and cheeks.

Gaussians learn shifts with the expression. Those of a rigid frame learn to undo the motion of the skin below them: on
glasses the undone share is about a half, and 0 elsewhere. But shifts end where the filmed faces end, and then a frame
bends. So such Gaussians are bound to a triangle that no expression moves. One alone says little: it counts with those
around it, and only if there are many.
"""

from collections.abc import Sequence as Items

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import LEAST_MOTION, BoundSurface
from mien.avatar.ops.regions import vertex_motions
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.face.params import FaceParams
from mien.gaussians import world_means

_UNDONE = 0.2
"""Share of the skin's motion that has to be undone around a Gaussian. On six clips without glasses, it is below .2 for
all but 18 Gaussians above the neck; of drawn glasses, 640 are above (log, 11-30)."""
_NEAREST = 16  # number of Gaussians around each, itself included, that the share is a mean over
_LEAST_COUNT = 50  # smallest number of Gaussians that make a rigid part
_STILL = 1e-6  # largest motion of a vertex, in metres per unit of an input, that counts as none


def carrier_of(
    face_model: FaceModel, subject: FaceParams, vertices: Float[Tensor, "v 3"], usable: Bool[Tensor, " f"]
) -> int | None:
    """The usable triangle of the scalp nearest to the eyes that no expression moves, or None.

    The vertices are those of the neutral head, in metres.
    """
    faces = face_model.faces.long()
    still = vertex_motions(face_model, subject).norm(dim=2).amax(0) < _STILL
    chosen = (still[faces].all(1) & usable & head_parts(face_model).scalp).nonzero()[:, 0]
    eyes = torch.stack(head_parts(face_model).eyes).any(0)
    if not len(chosen) or not bool(eyes.any()):
        return None
    middles = vertices[faces].mean(1)
    return int(chosen[(middles[chosen] - middles[eyes].mean(0)).norm(dim=1).argmin()])


@torch.no_grad()
def rigid_gaussians(
    avatar: Avatar, surface: BoundSurface, faces: Items[FaceParams], kept: Bool[Tensor, " f"]
) -> Int[Tensor, " k"]:
    """Gaussians that undo the motion of what they are bound to, at some timesteps, together with those around them.

    Those on `kept` triangles and on the neck are left alone.
    """
    model, still = avatar.face_model, avatar.subject
    posed = [(model.head_vertices(face)[0], avatar.pose(face).aux) for face in faces]
    undone, motion = surface.counter_motion(posed)
    left = kept | head_parts(model).neck.to(kept.device)
    looked = ((motion > LEAST_MOTION) & ~left[surface.triangles().long()]).nonzero()[:, 0]
    if len(looked) < max(_NEAREST, _LEAST_COUNT):
        return looked[:0]
    places = world_means(avatar.pose(still).gaussians.timestep(0))[looked].cpu().numpy()
    around = torch.from_numpy(KDTree(places).query(places, k=_NEAREST)[1]).to(looked.device)
    rigid = looked[undone[looked][around].clamp(-1, 1).mean(1) > _UNDONE]
    return rigid if len(rigid) >= _LEAST_COUNT else rigid[:0]
