"""Train only what is seen: what no training picture shows is not drawn in training, and filled after it."""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar import Avatar, Posed
from mien.face import FaceParams
from mien.training.completion import complete_colors
from mien.training.coverage import Coverage, coverage, drawn_share, smoothstep
from mien.training.frames import Frame
from mien.training.sequence import Sequence

_OPAQUE = 0.97
"""Opacity of a fill."""
_FADE = 4.0
"""Inverse of the share from which a triangle has no fill: what training draws covers it."""


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the training pictures show of a head, and how much of it training draws."""

    coverage: Coverage
    share: Float[Tensor, " f"]
    """Factor of the opacity of the Gaussians on each triangle in training, 0..1."""

    def hide(self, posed: Posed, avatar: Avatar) -> Posed:
        """Posed Gaussians as training draws them. All of them, if the method binds none to triangles."""
        triangles = avatar.triangles()
        if triangles is None:
            return posed
        share = self.share.to(posed.gaussians.opacities)[triangles]
        return replace(posed, gaussians=replace(posed.gaussians, opacities=posed.gaussians.opacities * share))

    def fill(self, avatar: Avatar) -> None:
        """Close what training did not draw, down to the neck line."""
        if avatar.triangles() is None:
            return
        found = self.coverage
        neutral = avatar.face_model.head_vertices(avatar.subject)[0].detach().cpu().float()
        colors = complete_colors(avatar.face_model.to(neutral), neutral, found.seen, found.colors)
        rare = 1 - smoothstep(self.share.cpu().float() * _FADE)
        avatar.fill(self.share, _OPAQUE * rare * found.above, colors)


@torch.no_grad()
def unseen_of(avatar: Avatar, sequences: Items[Sequence], faces: Items[FaceParams], frames: Items[Frame]) -> Unseen:
    """What some frames show of an avatar's head. The avatar is on the CPU, in float32."""
    found = coverage(avatar.face_model, sequences, faces, frames)
    return Unseen(found, drawn_share(avatar.face_model, found))
