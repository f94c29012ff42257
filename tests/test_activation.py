"""The native sigmoid agrees with torch's."""

import pytest
import torch

from mien import _native
from mien.avatar.ops.activation import sigmoid


@pytest.mark.parametrize("count", [0, 1, 15, 17, 40_001])
def test_values_and_gradients_equal_torchs(isa, count: int) -> None:
    values = 8 * torch.randn(count, generator=torch.Generator().manual_seed(1))
    ours, theirs = values.clone().requires_grad_(), values.double().requires_grad_()
    found, expected = sigmoid(ours), torch.sigmoid(theirs)
    torch.testing.assert_close(found.double(), expected, rtol=4e-6, atol=0)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=1.5e-7)
    (our_gradient,) = torch.autograd.grad(found.square().sum(), ours)
    (their_gradient,) = torch.autograd.grad(expected.square().sum(), theirs)
    torch.testing.assert_close(our_gradient.double(), their_gradient, rtol=0, atol=5e-7)


def test_far_out_and_nan(isa) -> None:
    """Values far out, infinities and NaN give what torch gives."""
    values = torch.tensor([-1e30, -200.0, 200.0, 1e30, torch.inf, -torch.inf, torch.nan, 0.0])
    found = sigmoid(values)
    torch.testing.assert_close(found, values.sigmoid(), equal_nan=True, rtol=1e-6, atol=1e-29)


def test_threads_do_not_matter() -> None:
    values, before = torch.randn(50_000, generator=torch.Generator().manual_seed(2)), _native.thread_count()
    results = []
    for threads in (1, 3):
        _native.set_thread_count(threads)
        results.append(sigmoid(values))
    _native.set_thread_count(before)
    assert torch.equal(*results)
