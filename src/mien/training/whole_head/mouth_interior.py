"""What is inside a head explains only what the mesh shows of it: eyeballs between lids, teeth between lips.

Triangles inside a mouth are a centimetre wide, and their Gaussians may lie that far from them. If nothing forbids it,
they come out through the skin, paint cheeks and closed lids, and are missing where the mouth opens.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mien.avatar.avatar import Avatar, Posed
from mien.avatar.bound_surface import BoundSurface
from mien.face.head_parts import head_parts
from mien.face.model import FaceModel
from mien.gaussians import sh_from_rgb
from mien.kernels import on_gpu
from mien.training.footage.coverage import Coverage
from mien.training.whole_head.completion import complete_colors

_MOUTH_CLOSED_AT = 0.5
"""Time at which an open surface inside the mouth is closed, as a fraction of the run. It is after the last opacity
reset of the presets, from which surface that is hardly ever seen does not recover. Measured against the first step only
(log, "Mouth")."""


def fill_interior(
    surface: BoundSurface, face_model: FaceModel, colors: Float[Tensor, "f 3"], step: int, steps: int
) -> None:
    """Close the mouth where it is open, if this is a step of a run of `steps` at which this is due."""
    if step == round(_MOUTH_CLOSED_AT * steps):
        surface.fill_interior(head_parts(face_model).interior.to(colors.device), colors)


@torch.no_grad()
def interior_colors(avatar: Avatar, covered: Coverage) -> Float[Tensor, "f 3"]:
    """Plausible colours inside an avatar's mouth: dark, with light teeth. The avatar is on the CPU.

    The mesh cannot say which part of a mouth pictures show, so all of it has completed colours.
    """
    model, interior = avatar.face_model, head_parts(avatar.face_model).interior
    neutral = model.head_vertices(avatar.subject)[0].detach().float()
    seen = torch.where(interior, 0.0, covered.seen)
    return complete_colors(model.to(neutral), neutral, seen, covered.colors)


def cover_hidden(
    posed: Posed, surface: BoundSurface, hidden: Bool[Tensor, " f"] | None, random: torch.Generator
) -> Posed:
    """Give hidden Gaussians one colour, drawn at random, so that they can explain nothing and have to be covered.

    Their opacities have no gradient: they must not fade because a skin that is still thin lets them through. Their
    places and sizes do have one, and so they leave where they do not belong.
    """
    if hidden is None:
        return posed
    gaussians, color = posed.gaussians, sh_from_rgb(torch.rand(3, generator=random))
    if on_gpu(gaussians.sh):
        from mien.training.training_gpu import covered

        sh, opacities = covered(gaussians.sh, gaussians.opacities, hidden, surface.triangles(), tuple(color.tolist()))
    else:
        own = hidden.index_select(0, surface.triangles())
        # Only on a CPU are rows found without waiting for the device.
        cover = _Covered.apply if own.is_cpu else covered_reference
        sh, opacities = cover(gaussians.sh, gaussians.opacities, own, color.to(gaussians.sh))
    return replace(posed, gaussians=replace(gaussians, sh=sh, opacities=opacities))


def covered_reference(
    sh: Float[Tensor, "n k 3"], opacities: Float[Tensor, " n"], own: Bool[Tensor, " n"], color: Float[Tensor, " 3"]
) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, " n"]]:
    """Coefficients of which some rows are one constant colour, and opacities that have no gradient in these rows."""
    degrees = torch.zeros_like(sh[:1, :, :1])
    degrees[:, :1] = 1
    return torch.where(own[:, None, None], degrees * color, sh), torch.where(own, opacities.detach(), opacities)


class _Covered(torch.autograd.Function):
    """`covered_reference` in a third of its time, because it touches only the rows that change."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, opacities: Tensor, own: Tensor, color: Tensor) -> tuple[Tensor, Tensor]:
        ctx.rows = own.nonzero()[:, 0]
        changed = sh.detach().clone().index_fill_(0, ctx.rows, 0.0)
        changed[:, 0].index_copy_(0, ctx.rows, color.expand(len(ctx.rows), 3))
        return changed, opacities.detach().clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *(gradient.clone().index_fill_(0, ctx.rows, 0.0) for gradient in gradients), None, None
