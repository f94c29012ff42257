"""`keep_on_surface` in one kernel for a GPU, with the pull of colours."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from torch import Tensor

from mien.kernels import blocks, launch

_BLOCK = 128


@torch.no_grad()
def keep_on_surface(
    face_index: Tensor, limits: Tensor, spread: float, shapes: tuple[Tensor, Tensor, Tensor], colors: Tensor,
    pulls: Tensor | None,
) -> None:  # fmt: skip
    """Bring means, quats and log scales back to the limits of their triangles, and pull colours, all in place.

    `spread` is the logarithm of the largest ratio of scales along the surface. Colours are rows [n, k, 3] of SH
    coefficients, of which the first is pulled.
    """
    n, width = len(face_index), colors[0].numel() if len(colors) else 3
    launch(
        _keep, blocks(n, _BLOCK), face_index, limits.contiguous(), *shapes, colors,
        limits if pulls is None else pulls.contiguous(), n, width, spread, PULLS=pulls is not None, BLOCK=_BLOCK,
    )  # fmt: skip


@no_type_check
@triton.jit
def _keep(
    face_index, limits, means, quats, log_scales, colors, pulls, n, width, spread, PULLS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = row < n
    triangle = tl.load(face_index + row, mask=there, other=0)
    own = limits + 5 * triangle
    # The second axis of a triangle's frame is its normal. Comparisons with NaN are false, so NaN stays.
    low, high = tl.load(own, mask=there, other=0.0), tl.load(own + 1, mask=there, other=0.0)
    place = tl.load(means + 3 * row + 1, mask=there, other=0.0)
    place = tl.where(place < low, low, place)
    tl.store(means + 3 * row + 1, tl.where(place > high, high, place), mask=there)
    thickest, widest = tl.load(own + 2, mask=there, other=0.0), tl.load(own + 3, mask=there, other=0.0)
    across = tl.load(log_scales + 3 * row, mask=there, other=0.0)
    thick = tl.load(log_scales + 3 * row + 1, mask=there, other=0.0)
    along = tl.load(log_scales + 3 * row + 2, mask=there, other=0.0)
    across, along = tl.where(across > widest, widest, across), tl.where(along > widest, widest, along)
    tl.store(log_scales + 3 * row + 1, tl.where(thick > thickest, thickest, thick), mask=there)
    tl.store(log_scales + 3 * row, tl.where(across < along - spread, along - spread, across), mask=there)
    tl.store(log_scales + 3 * row + 2, tl.where(along < across - spread, across - spread, along), mask=there)
    w, x = tl.load(quats + 4 * row, mask=there, other=1.0), tl.load(quats + 4 * row + 1, mask=there, other=0.0)
    y, z = tl.load(quats + 4 * row + 2, mask=there, other=0.0), tl.load(quats + 4 * row + 3, mask=there, other=0.0)
    norm = tl.sqrt(w * w + x * x + y * y + z * z)
    scale = 1 / tl.where(norm < 1e-12, 1e-12, norm)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    # The sine of half the angle between the thin axis and the normal is the length of the second and fourth number.
    most, tilted = tl.load(own + 4, mask=there, other=1.0), tl.sqrt(x * x + z * z)
    beyond, level = x * x + z * z > most * most, tl.sqrt(w * w + y * y)
    aside = tl.where(beyond, most / tl.where(tilted < 1e-12, 1e-12, tilted), 1.0)
    rest = 1 - most * most
    rest = tl.sqrt(tl.where(rest < 0, 0.0, rest))
    upright = tl.where(beyond, rest / tl.where(level < 1e-6, 1e-6, level), 1.0)
    tl.store(quats + 4 * row, w * upright, mask=there)
    tl.store(quats + 4 * row + 1, x * aside, mask=there)
    tl.store(quats + 4 * row + 2, y * upright, mask=there)
    tl.store(quats + 4 * row + 3, z * aside, mask=there)
    if PULLS:
        share = tl.load(pulls + 4 * triangle + 3, mask=there, other=0.0)
        for i in tl.static_range(3):
            color = tl.load(colors + width * row + i, mask=there, other=0.0)
            goal = tl.load(pulls + 4 * triangle + i, mask=there, other=0.0)
            tl.store(colors + width * row + i, color + share * (goal - color), mask=there)
