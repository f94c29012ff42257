"""The memory of large pictures is used again."""

import pytest
import torch
from torch import Tensor

from mien.arrays import native, recycled

LARGE = (1024, 1025)


def test_memory_is_used_again_but_never_while_somebody_holds_it() -> None:
    first = recycled(*LARGE)
    address = first.data_ptr()
    view = first[10:].requires_grad_()
    del first
    second = recycled(*LARGE)
    assert second.data_ptr() != address
    del view
    assert recycled(*LARGE).data_ptr() == address


def test_a_recycled_tensor_is_like_any_other() -> None:
    tensor = recycled(1100, 1000)
    assert tensor.shape == (1100, 1000)
    assert tensor.dtype == torch.float32
    assert tensor.is_contiguous()
    assert tensor.data_ptr() % 64 == 0
    tensor.fill_(2)
    assert float(tensor.sum()) == 2.2e6
    assert recycled(0, 3).shape == (0, 3)
    assert recycled(4, 0).numel() == 0


@pytest.mark.parametrize(
    ("first", "second", "taken"),
    [
        (torch.zeros(2), torch.zeros(2, dtype=torch.int32), "core"),
        (torch.zeros(2), torch.zeros(2, dtype=torch.float64), "reference"),
        (torch.zeros(2, device="meta"), torch.zeros(2), "reference"),
        (torch.zeros(2, dtype=torch.float16), torch.zeros(2), "reference"),
    ],
)
def test_the_reference_computes_what_the_core_cannot_take(first: Tensor, second: Tensor, taken: str) -> None:
    @native(lambda *_, **__: "reference")
    def operation(*_: Tensor, **__: Tensor) -> str:
        return "core"

    assert operation(first, second) == operation(first, named=second) == taken
