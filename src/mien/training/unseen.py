"""Sides of the head that no training picture shows: a closed surface in completed colours from the first step on.

What no picture shows must not help to explain pictures. Gaussians on such triangles are made up: opaque and flat, at
the height of hair, in completed colours. Training changes nothing of them but their opacity, and that only where
pictures clearly contradict them, as where they stand out beyond the outline.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mien.avatar import Avatar, DensityControl, GaussianStore, GradientDensity, SurfacePrior
from mien.face import FaceParams
from mien.render.rendering import Rendering
from mien.training.completion import complete_colors
from mien.training.coverage import Coverage, coverage, drawn_share
from mien.training.frames import Frame
from mien.training.hair_height import hair_height
from mien.training.sequence import Sequence

_RARE = 0.1
"""Share of confidence below which a triangle is made up."""
_CONTRADICTION = 3e-5
"""Gradient of an opacity (logit) from which pictures contradict a fill. A little light shines through every avatar, so
small gradients reach what is hidden."""


@dataclass(frozen=True, eq=False)
class Unseen:
    """What the training pictures show of a head, and what is known of the rest."""

    coverage: Coverage | None
    """None if only limits to the surface were asked for."""
    prior: SurfacePrior

    def made_up(self, store: GaussianStore) -> Bool[Tensor, " n"] | None:
        """The Gaussians that are filled rather than trained."""
        return None if self.prior.made_up is None else self.prior.made_up[store["face_index"]]

    def guard(self, avatar: Avatar, rendering: Rendering) -> None:
        """Take the gradients from what is made up, after the backward pass, but for strong ones of opacity."""
        store = avatar.gaussian_store()
        made_up = self.made_up(store)
        if made_up is None:
            return
        density = avatar.density()
        opacity = density.opacity_logits if isinstance(density, GradientDensity) else None
        for name in store.trained:
            gradient = store[name].grad
            if gradient is None:
                continue
            if name == opacity:
                strong = gradient.sign() * (gradient.abs() - _CONTRADICTION).clamp_min(0)
                gradient.copy_(torch.where(made_up, strong, gradient))
            else:
                gradient.masked_fill_(made_up.view(-1, *[1] * (gradient.ndim - 1)), 0)
        if rendering.means2d_offset.grad is not None:
            rendering.means2d_offset.grad.masked_fill_(made_up[:, None], 0)


def spare_fills(density: DensityControl, unseen: Unseen | None) -> DensityControl:
    """The density control of an avatar whose fills keep their opacity at resets."""
    if unseen is None or unseen.prior.made_up is None or not isinstance(density, GradientDensity):
        return density

    def may_reset(store: GaussianStore) -> Bool[Tensor, " n"]:
        made_up = unseen.made_up(store)
        assert made_up is not None
        return ~made_up

    return replace(density, may_reset=may_reset)


@torch.no_grad()
def unseen_of(
    avatar: Avatar, sequences: Items[Sequence], faces: Items[FaceParams], frames: Items[Frame], *, filled: bool
) -> Unseen:
    """What some frames show of an avatar's head. The avatar is on the CPU, in float32."""
    model = avatar.face_model
    hair = hair_height(model, sequences, faces, frames)
    if not filled:
        return Unseen(None, SurfacePrior(hair))
    found = coverage(model, sequences, faces, frames)
    neutral = model.head_vertices(avatar.subject)[0].detach()
    colors = complete_colors(model, neutral, found.seen, found.colors)
    shown = drawn_share(model, found)
    doubt: Float[Tensor, " f"] = (1 - shown) * found.above
    return Unseen(found, SurfacePrior(hair, colors, doubt, (shown < _RARE) & (found.above > 0.5)))


def moved(unseen: Unseen, like: Tensor) -> Unseen:
    """The same on the device of `like`."""
    prior = unseen.prior
    tensors = {name: getattr(prior, name) for name in ("hair", "colors", "doubt", "made_up")}
    put = {
        name: None if t is None else t.to(like if t.is_floating_point() else like.device) for name, t in tensors.items()
    }
    return replace(unseen, prior=SurfacePrior(**put))
