"""Limits that keep Gaussians on the surface of the mesh, where one camera cannot see how deep they lie."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.gaussian_avatars.settings import SurfaceLimits
from mien.avatar.store import GaussianStore


@torch.no_grad()
def keep_on_surface(
    store: GaussianStore,
    limits: SurfaceLimits,
    sizes: Float[Tensor, " f"],
    hair: Float[Tensor, " f"],
    widening: Float[Tensor, " f"] | None = None,
) -> None:
    """Bring Gaussians that are beyond the limits back to them, in place.

    Args:
        store: Gaussians with `face_index, means, quats, log_scales` in the frames of their triangles.
        limits: The limits.
        sizes: Sizes of the triangles, in metres per triangle unit.
        hair: Height of hair above each triangle, in metres; 0 where there is none.
        widening: Factors on the depth, the thickness and the tilt. None means 1.
    """
    bound = store["face_index"]
    means, quats, log_scales = (store[name].detach() for name in ("means", "quats", "log_scales"))
    # The second axis of a triangle's frame is its normal.
    widen = torch.ones_like(sizes) if widening is None else widening
    depth, thickness = limits.depth * widen, limits.thickness * widen
    lowest, highest = -depth / sizes, (depth + limits.hair_share * hair) / sizes
    thickest = ((thickness + limits.hair_thickness * hair) / sizes).log()
    widest = ((limits.width + limits.hair_width * hair) / sizes).log()
    low, high, thick, wide = torch.stack([lowest, highest, thickest, widest], dim=1)[bound].unbind(1)
    means[:, 1].clamp_(low, high)
    log_scales[:, 1].clamp_(max=thick)
    across, along = (torch.minimum(log_scales[:, axis], wide) for axis in (0, 2))
    # The shorter one grows. No picture holds it once it is thinner than a pixel, and it would draw the other with it.
    log_scales[:, 0] = torch.maximum(across, along - math.log(limits.ratio))
    log_scales[:, 2] = torch.maximum(along, across - math.log(limits.ratio))
    quats /= torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
    # The sine of half the angle between the thin axis and the normal is the length of the second and the fourth number.
    most = (0.5 * math.radians(limits.tilt) * widen).clamp(max=0.5 * math.pi).sin()[bound]
    beyond = (quats[:, 1].square() + quats[:, 3].square() > most * most).nonzero()[:, 0]
    leaning, most = quats[beyond], most[beyond]
    tilted, level = torch.hypot(leaning[:, 1], leaning[:, 3]), torch.hypot(leaning[:, 0], leaning[:, 2])
    aside, upright = most / tilted.clamp_min(1e-12), (1 - most * most).clamp_min(0).sqrt() / level.clamp_min(1e-6)
    quats[beyond] = leaning * torch.stack([upright, aside, upright, aside], dim=1)
