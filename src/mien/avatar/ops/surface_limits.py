"""Limits that keep Gaussians flat on the surface of the mesh, where one camera cannot see how deep they lie.

Without them, skin that was trained from the front falls to shards when it is seen from the side: true tracking, 30
degrees, 16.88 -> 18.65 dB, 90 degrees 13.59 -> 15.52, front -0.2 (log, 11-23). Lengths are those of the neutral head.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mien import _native
from mien.arrays import is_native, unpacked
from mien.avatar.ops import Tensors
from mien.kernels import on_gpu

DEPTH = 0.003  # largest distance of a centre from the mesh along the normal, in metres. Not better: 6 mm with tilt 45
HAIR_SHARE = 1.3  # how far a centre may lie above the scalp, beside the depth, as a multiple of the height of hair
THICKNESS = 0.0005  # largest scale (standard deviation) along the normal, in metres
HAIR_THICKNESS = 0.3  # what is added to the thickness on the scalp, as a multiple of the height of hair
WIDTH = 0.006  # largest scale along the surface, in metres
HAIR_WIDTH = 1.0  # what is added to the width on the scalp, as a multiple of the height of hair
RATIO = 5.0  # largest ratio of the two scales along the surface. Larger ones are needles
TILT = 20.0  # largest angle between a Gaussian's thin axis and the normal, in degrees
_COLORS = "sh_constant"


@torch.no_grad()
def limits_of_triangles(
    sizes: Float[Tensor, " f"], hair: Float[Tensor, " f"], widening: Float[Tensor, " f"] | None = None
) -> Float[Tensor, "f 5"]:
    """The limits in the frames of the triangles, for `keep_on_surface`.

    They are the lowest and the highest place along the normal, the logarithms of the largest thickness and width, and
    the sine of half the largest tilt. Sizes are in metres per triangle unit, heights of hair in metres, and `widening`
    are factors on depth, thickness and tilt.
    """
    widen = torch.ones_like(sizes) if widening is None else widening
    depth, thickness = DEPTH * widen, THICKNESS * widen
    lowest, highest = -depth / sizes, (depth + HAIR_SHARE * hair) / sizes
    thickest = ((thickness + HAIR_THICKNESS * hair) / sizes).log()
    widest = ((WIDTH + HAIR_WIDTH * hair) / sizes).log()
    most = (0.5 * math.radians(TILT) * widen).clamp(max=0.5 * math.pi).sin()
    return torch.stack([lowest, highest, thickest, widest, most], dim=1)


@torch.no_grad()
def keep_on_surface(store: Tensors, limits: Float[Tensor, "f 5"], pulls: Float[Tensor, "f 4"] | None = None) -> None:
    """Bring Gaussians that are beyond the limits back to them, in place. Native for float32 on a CPU.

    `pulls` are, of each triangle, a first SH coefficient and the share of the way that colours go towards it.
    """
    names = ("means", "quats", "log_scales")
    arrays = [store[name] for name in names]
    colors = store[_COLORS].view(-1, 3) if pulls is not None else arrays[0]
    if is_native(*arrays, colors, limits) and all(own.is_contiguous() for own in (*arrays, colors)):
        own = None if pulls is None else pulls.contiguous()
        means, quats, log_scales = unpacked(*arrays)
        triangle, table, pull, color = unpacked(
            store["face_index"].long().contiguous(), limits.contiguous(), own, colors
        )
        _native.keep_on_surface(triangle, table, math.log(RATIO), means, quats, log_scales, pull, color)
        return
    if on_gpu(*arrays, limits) and all(own.is_contiguous() for own in arrays):
        from mien.avatar.ops.surface_limits_gpu import keep_on_surface as on_device

        means, quats, log_scales = arrays
        on_device(
            store["face_index"], limits, math.log(RATIO), (means, quats, log_scales), store[_COLORS].detach(), pulls
        )
        return
    keep_on_surface_reference(store, limits)
    if pulls is not None:
        pull_colors(store, pulls)


@torch.no_grad()
def keep_on_surface_reference(store: Tensors, limits: Float[Tensor, "f 5"]) -> None:
    """`keep_on_surface` in plain PyTorch, any dtype and device, without colours."""
    means, quats, log_scales = (store[name].detach() for name in ("means", "quats", "log_scales"))
    low, high, thick, wide, most = limits[store["face_index"]].unbind(1)
    # The second axis of a triangle's frame is its normal.
    means[:, 1].clamp_(low, high)
    log_scales[:, 1].clamp_(max=thick)
    across, along = (torch.minimum(log_scales[:, axis], wide) for axis in (0, 2))
    # The shorter one grows. No picture holds it once it is thinner than a pixel, and it would draw the other with it.
    log_scales[:, 0] = torch.maximum(across, along - math.log(RATIO))
    log_scales[:, 2] = torch.maximum(along, across - math.log(RATIO))
    quats /= torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(1e-12)
    # The sine of half the angle between the thin axis and the normal is the length of the second and the fourth number.
    beyond = (quats[:, 1].square() + quats[:, 3].square() > most * most).nonzero()[:, 0]
    leaning, most = quats[beyond], most[beyond]
    tilted, level = torch.hypot(leaning[:, 1], leaning[:, 3]), torch.hypot(leaning[:, 0], leaning[:, 2])
    aside, upright = most / tilted.clamp_min(1e-12), (1 - most * most).clamp_min(0).sqrt() / level.clamp_min(1e-6)
    quats[beyond] = leaning * torch.stack([upright, aside, upright, aside], dim=1)


@torch.no_grad()
def pull_colors(store: Tensors, pulls: Float[Tensor, "f 4"]) -> None:
    """Move the first SH coefficient of each Gaussian some way towards that of its triangle, in place."""
    colors, own = store[_COLORS].detach()[:, 0], pulls[store["face_index"]]
    colors += own[:, 3:] * (own[:, :3] - colors)
