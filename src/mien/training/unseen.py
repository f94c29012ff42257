"""Train only what is seen: what no training picture shows is not drawn in training, and filled after it."""

from collections.abc import Iterable
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar import Avatar, GradientDensity, Posed
from mien.camera import Camera
from mien.face import FaceParams
from mien.render import rasterize
from mien.training.completion import complete_colors
from mien.training.coverage import Coverage, coverage, drawn_share, smoothstep
from mien.training.frames import Frame
from mien.training.losses import picture_losses
from mien.training.sequence import Sequence, Target

_OPAQUE = 0.97
"""Opacity of a fill."""
_FADE = 4.0
"""Inverse of the share from which a triangle has no fill: what training draws covers it."""

TRIM_STEPS = 600
"""Number of steps that fit the fills' opacities to training pictures."""
_TRIM_RATE, _TRIM_EPSILON = 0.1, 3e-5
"""Learning rate of the fills' opacities (logits), and the epsilon of Adam, below which gradients have no say: a fill
that shines through what hides it must not fade."""


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

    def fill(self, avatar: Avatar) -> int:
        """Close what training did not draw, down to the neck line. Returns the number of fills, the last Gaussians."""
        if avatar.triangles() is None:
            return 0
        found = self.coverage
        neutral = avatar.face_model.head_vertices(avatar.subject)[0].detach().cpu().float()
        colors = complete_colors(avatar.face_model.to(neutral), neutral, found.seen, found.colors)
        rare = 1 - smoothstep(self.share.cpu().float() * _FADE)
        return avatar.fill(self.share, _OPAQUE * rare * found.above, colors)


def trim_fills(avatar: Avatar, count: int, views: Iterable[tuple[FaceParams, Camera, Target]]) -> None:
    """Make fills faint that the training pictures contradict, such as those that stand out beyond the outline.

    Only the opacities of the fills are fitted. Fills that no picture shows have no gradient and stay as they are.

    Args:
        avatar: The avatar, whose last Gaussians are the fills.
        count: The number of fills.
        views: Training pictures with the face and the camera of each.
    """
    density = avatar.density()
    name = density.opacity_logits if isinstance(density, GradientDensity) else None
    if count == 0 or name is None:
        return
    store = avatar.gaussian_store()
    logits = store[name].detach()
    fills = logits[-count:].clone().requires_grad_()
    adam = torch.optim.Adam([fills], lr=_TRIM_RATE, eps=_TRIM_EPSILON)
    for face, camera, target in views:
        with torch.no_grad():
            gaussians = avatar.pose(face).gaussians.timestep(0)
        opacities = torch.cat([gaussians.opacities[:-count], fills.sigmoid()])
        rendering = rasterize(replace(gaussians, opacities=opacities), camera, target.background)
        adam.zero_grad()
        picture_losses(rendering, target, avatar.config.photometric)["photometric"].backward()
        adam.step()
    # A fill is never more opaque than it was made.
    kept = torch.minimum(fills.detach(), logits[-count:])
    store.assign(name, torch.cat([logits[:-count], kept]))


@torch.no_grad()
def unseen_of(avatar: Avatar, sequences: Items[Sequence], faces: Items[FaceParams], frames: Items[Frame]) -> Unseen:
    """What some frames show of an avatar's head. The avatar is on the CPU, in float32."""
    found = coverage(avatar.face_model, sequences, faces, frames)
    return Unseen(found, drawn_share(avatar.face_model, found))
