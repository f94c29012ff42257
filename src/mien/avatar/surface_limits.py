"""Limits that keep Gaussians on the surface of the mesh, where one camera cannot see how deep they lie."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien.avatar.gaussian_avatars_settings import SurfaceLimits
from mien.avatar.store import GaussianStore


@torch.no_grad()
def keep_on_surface(
    store: GaussianStore, limits: SurfaceLimits, sizes: Float[Tensor, " f"], hair: Float[Tensor, " f"]
) -> None:
    """Bring Gaussians that are beyond the limits back to them, in place.

    Args:
        store: Gaussians with `face_index, means, quats, log_scales` in the frames of their triangles.
        limits: The limits.
        sizes: Sizes of the triangles, in metres per triangle unit.
        hair: Height of hair above each triangle, in metres; 0 on skin.
    """
    bound = store["face_index"]
    size, height = sizes[bound], hair[bound]
    means, quats, log_scales = (store[name].detach() for name in ("means", "quats", "log_scales"))
    # The second axis of a triangle's frame is its normal.
    lowest, highest = -limits.depth / size, (limits.depth + limits.hair_share * height) / size
    means[:, 1] = torch.minimum(torch.maximum(means[:, 1], lowest), highest)
    thickest = ((limits.thickness + limits.hair_thickness * height) / size).log()
    widest = ((limits.width + limits.hair_width * height) / size).log()
    log_scales[:, 1] = torch.minimum(log_scales[:, 1], thickest)
    across, along = (torch.minimum(log_scales[:, axis], widest) for axis in (0, 2))
    # The shorter one grows. No picture holds it once it is thinner than a pixel, and it would draw the other with it.
    log_scales[:, 0] = torch.maximum(across, along - math.log(limits.ratio))
    log_scales[:, 2] = torch.maximum(along, across - math.log(limits.ratio))
    quats /= torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
    # The sine of half the angle between the thin axis and the normal is the length of the second and the fourth number.
    tilted, level = torch.hypot(quats[:, 1], quats[:, 3]), torch.hypot(quats[:, 0], quats[:, 2])
    most = math.sin(math.radians(limits.tilt) / 2)
    beyond = tilted > most
    aside = torch.where(beyond, most / tilted.clamp_min(1e-12), 1.0)
    upright = torch.where(beyond, math.sqrt(1 - most * most) / level.clamp_min(1e-6), 1.0)
    quats *= torch.stack([upright, aside, upright, aside], dim=1)
