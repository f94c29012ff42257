"""A soft cut: opacity fades towards the neck cut, so that a head that is shown ends softly and not in frayed ends."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.face.torso import has_torso
from mien.gaussians import world_means
from mien.tracking.neck_cut import NeckCut, NeckParts, fit_neck_cut
from mien.training.footage.coverage import smoothstep

if TYPE_CHECKING:
    from mien.runtime.baked import PortableAvatar

SOFT_CUT_WIDTH = 0.03
"""Distance from the neck cut over which opacity fades where a head is shown, in metres. 2 to 4 cm were looked at on
four clips; with 2 cm, the end of a bare neck is tufted."""
_SOFT_CUT_POWER = 1.5
"""Power of the fading share. Gaussians lie over each other, and together hide more than each alone: with 1, the end of
the neck is jagged over dark backgrounds; with 3, half of the neck goes. Looked at on seven clips."""
SOFT_CUT_OFF_SKIN = (0.005, 0.012)
"""Distances from the mesh up to which nothing stands off the skin, and from which on what does so is not shown just
above the cut, in metres. With 3 to 8 mm, necks themselves thin out. Looked at on seven clips."""
SOFT_CUT_COLLAR = (0.025, 0.05)
"""Heights above the cut below which what stands off the skin goes, and from which on it stays, in metres. With 5 to 8
cm, long hair (d3, s18) is bitten off beside the neck."""
SOFT_CUT_HEAD = (0.008, 0.02)
"""Distances from the vertices of the head without its neck up to which nothing is cut off, and from which on the cut
counts alone, in metres. A chin may reach below the cut. Set by eye."""
SOFT_CUT_LEAST = 1e-4  # least opacity after the soft cut

_PART = 4096
"""Gaussians whose distances are computed at once."""


@torch.no_grad()
def with_soft_cut(portable: "PortableAvatar", avatar: Avatar) -> "PortableAvatar":
    """The record of an avatar whose opacity fades towards the neck cut.

    Training and scoring cut heads off sharply, because their truth is cut off sharply. What is shown need not be. The
    avatar's neck at rest places the cut. Records whose Gaussians have no opacities of their own stay as they are, and
    so do those with a torso, whose end fades in training.
    """
    attributes = getattr(portable.baked, "attributes", None)
    if attributes is None or has_torso(avatar.face_model):
        return portable
    shares = shares_left(avatar).double().cpu().numpy()
    opacities = shares / (1 + np.exp(-attributes.opacity_logits.astype(np.float64)))
    opacities = opacities.clip(SOFT_CUT_LEAST, 1 - SOFT_CUT_LEAST)
    logits = np.log(opacities / (1 - opacities)).astype(np.float32)
    kept = np.where(shares < 1, logits, attributes.opacity_logits)
    return replace(portable, baked=replace(portable.baked, attributes=replace(attributes, opacity_logits=kept)))


@torch.no_grad()
def shares_left(avatar: Avatar) -> Float[Tensor, " n"]:
    """For each Gaussian of an avatar, the share of its opacity that the soft cut leaves, 0..1.

    It is computed on the CPU, and comes with the device and the dtype of the avatar.
    """
    gaussians = avatar.pose(avatar.subject).gaussians.timestep(0)
    if has_torso(avatar.face_model):
        return torch.ones_like(gaussians.means[:, 0])
    on_cpu = torch.zeros((), dtype=gaussians.means.dtype)
    model, rest = avatar.face_model.to(on_cpu), avatar.subject.to(on_cpu)
    vertices = model(rest)[0]
    cut = fit_neck_cut(NeckParts.of(model), vertices, rest.T_world_head[0, :3, 1])
    head = vertices[model.faces[~model.region_mask("neck")].unique()]
    skin = torch.cat([vertices, vertices[model.faces].mean(1)])
    return opacity_shares(world_means(gaussians).to(on_cpu), cut, head, skin).to(gaussians.means)


def opacity_shares(
    centers: Float[Tensor, "n 3"], cut: NeckCut, head: Float[Tensor, "m 3"], skin: Float[Tensor, "k 3"]
) -> Float[Tensor, " n"]:
    """The share of each opacity that is left: 0 at the cut, 1 far from it and on the head.

    Just above the cut, what stands off the skin fades as well: shards of collars, and corners where a neck widens. What
    is close to the head is not cut off. All is at rest in the world, in metres.
    """
    shares = smoothstep(cut.margins(centers) / SOFT_CUT_WIDTH) ** _SOFT_CUT_POWER
    low, high = SOFT_CUT_COLLAR
    above = smoothstep((cut.heights(centers) - low) / (high - low))
    near = (shares < 1) | (above < 1)  # distances take time, and most Gaussians are far above
    close, off = SOFT_CUT_OFF_SKIN
    on_skin = smoothstep((off - _distances(centers[near], skin)) / (off - close))
    first, last = SOFT_CUT_HEAD
    on_head = smoothstep((last - _distances(centers[near], head)) / (last - first))
    shares[near] = torch.maximum(shares[near] * torch.maximum(on_skin, above[near]), on_head)
    return shares


def _distances(centers: Float[Tensor, "n 3"], points: Float[Tensor, "m 3"]) -> Float[Tensor, " n"]:
    return torch.cat([torch.cdist(part, points).amin(1) for part in centers.split(_PART)])
