"""How much each Gaussian adds to training pictures, and what becomes of those that add nothing.

Density control duplicates Gaussians with strong gradients. Soon many of them lie under others, where no picture shows
them. They are not trained any more, count towards the limit, and show as specks in odd colours from the side. After
each round, those that hardly add to any of a few pictures are removed. If all Gaussians of a triangle are such, one
stays and becomes what it was in the beginning: a closed surface in the completed colour.
"""

from collections.abc import Sequence as Items
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar.avatar import Avatar
from mien.avatar.bound_surface import BoundSurface
from mien.camera import Camera
from mien.face.params import FaceParams
from mien.gaussians import SH_C0
from mien.machine.parallel import stream_in_threads
from mien.render import rasterize
from mien.training.whole_head.unseen import Unseen

_HIDDEN_CONTRIBUTION = 0.03
"""Contribution below which a Gaussian counts as hidden, in pixels of the training picture that shows it best. Of the
Gaussians of a run, 40 % were below 1/8 (log, 11-24)."""


def contributions(avatar: Avatar, views: Items[tuple[FaceParams, Camera]]) -> Float[Tensor, " n"]:
    """The most that each Gaussian adds to one of the views: the sum of its weights in the blending, in pixels.

    The weight of a Gaussian in a pixel is its alpha times the transmittance in front of it (3D Gaussian Splatting,
    equation 3). It is the derivative of the picture by the Gaussian's colour. A view is one timestep and a camera.
    """
    most = torch.zeros(len(avatar.store), device=avatar.face_model.template.device)

    @torch.enable_grad()
    def of_view(view: tuple[FaceParams, Camera]) -> Float[Tensor, " n"]:
        with torch.no_grad():
            gaussians = avatar.pose(view[0]).gaussians.timestep(0)
        colors = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_()
        picture = rasterize(replace(gaussians, sh=colors), view[1], colors.new_zeros(3)).image
        (found,) = torch.autograd.grad(picture[..., 0].sum(), colors)
        return found[:, 0, 0].to(most) / SH_C0

    for own in stream_in_threads(of_view, views, None if most.is_cpu else 1):
        most = torch.maximum(most, own)
    return most


def prune_hidden(
    avatar: Avatar, surface: BoundSurface, unseen: Unseen, views: Items[tuple[FaceParams, Camera]], *, close: bool
) -> Bool[Tensor, " n"]:
    """Deal with Gaussians that hardly add to any view, and return which are to be removed.

    One Gaussian stays on each triangle. If it is hidden, it gets the completed colour and, with `close`, also place,
    shape and opacity of a fill, which training then fits to the pictures. Filled sides and the inside of the mouth
    are left alone.
    """
    prior, triangles = unseen.prior, surface.triangles()
    kept = prior.filled_in if prior.closed is None else prior.closed
    assert kept is not None
    hidden = (contributions(avatar, views) < _HIDDEN_CONTRIBUTION) & ~kept[triangles]
    shown = torch.zeros_like(kept).index_put((triangles[~hidden],), torch.ones_like(hidden[~hidden]))
    order = torch.arange(len(hidden), device=hidden.device)
    first = torch.full_like(kept, len(hidden), dtype=torch.long)
    first = first.scatter_reduce(0, triangles[hidden].long(), order[hidden], "amin")
    stays = hidden & ~shown[triangles] & (order == first[triangles])
    surface.restore(stays.nonzero()[:, 0], prior, close=close)
    return hidden & ~stays
