"""Rows of several tensors set to 0 in one launch on a GPU."""

from collections.abc import Sequence
from typing import no_type_check

import triton
import triton.language as tl
from torch import Tensor

from mien.kernels import blocks, launch

_BLOCK = 128


def clear_rows(chosen: Tensor, tensors: Sequence[Tensor]) -> None:
    """Set the chosen rows of all tensors [n, ...] to 0, in place."""
    n, own = len(chosen), tuple(one for one in tensors if one.numel())
    widths = tuple(one[0].numel() for one in own)
    launch(_clear, blocks(n, _BLOCK), chosen, own, n, WIDTHS=widths, BLOCK=_BLOCK)


@no_type_check
@triton.jit
def _clear(chosen, tensors, n, WIDTHS: tl.constexpr, BLOCK: tl.constexpr):
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    known = tl.load(chosen + row, mask=row < n, other=0) != 0
    for i in tl.static_range(len(tensors)):
        for column in range(WIDTHS[i]):
            tl.store(tensors[i] + row * WIDTHS[i] + column, tl.zeros([BLOCK], tensors[i].dtype.element_ty), mask=known)
