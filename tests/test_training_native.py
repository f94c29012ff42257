"""The native parts of a training step agree with their plain PyTorch twins."""

import pytest
import torch
from torch import Tensor

from mien import _native
from mien.avatar import Moments
from mien.training.adam import Update, update_all, update_reference
from mien.training.density_control.gradient import observe_reference
from mien.training.losses import alpha_loss, alpha_loss_reference

COUNTS = (0, 1, 15, 16, 4097)


def random(*shape: int, seed: int = 0) -> Tensor:
    """Return standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", COUNTS)
def test_adam_update_equals_its_reference(isa: str, count: int) -> None:
    def twin() -> Update:
        moments = Moments(0.1 * random(count, seed=1), random(count, seed=2).square(), torch.tensor(3.0))
        return Update(random(count, seed=3), random(count, seed=4), moments, 0.01)

    ours, theirs = twin(), twin()
    update_all([ours, twin()])
    update_reference(theirs)
    assert ours.moments.step == theirs.moments.step == 4
    # If the second moment is small, an update is large (up to 10), and its last digits differ in float32.
    torch.testing.assert_close(ours.values, theirs.values, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(ours.moments.first, theirs.moments.first, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(ours.moments.second, theirs.moments.second, rtol=1e-5, atol=1e-6)


def test_adam_takes_what_is_not_dense_by_the_reference() -> None:
    values = torch.zeros(4, 3)
    update_all([Update(values, torch.ones(1, 3).expand(4, 3), Moments.zeros(values), 0.1)])
    torch.testing.assert_close(values, torch.full((4, 3), -0.1))


@pytest.mark.parametrize("count", COUNTS)
def test_observing_a_view_equals_its_reference(isa: str, count: int) -> None:
    radii = torch.randint(0, 3, (count,), generator=torch.Generator().manual_seed(2), dtype=torch.int32)
    arguments = (random(count, 2), radii, random(count, seed=5).sigmoid(), (256.0, 128.0))

    def statistics() -> tuple[Tensor, ...]:
        floats = (random(count, seed=6).abs(), random(count, seed=7).abs(), random(count, seed=8).sigmoid())
        return floats[0], floats[1], torch.ones(count, dtype=torch.int32), floats[2]

    ours, theirs = statistics(), statistics()
    _native.observe_view(arguments[3], *arguments[:3], *ours)
    observe_reference(*arguments, *theirs)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 130)])
def test_box_of_nonzero(isa: str, size: tuple[int, int]) -> None:
    """The box of nonzero values is the smallest one."""
    values = torch.zeros(size)
    assert _native.box_of_nonzero(values) == (0, 0, 0, 0)
    for pixel in ((size[0] - 1, size[1] // 2), (size[0] // 3, size[1] - 1), (size[0] // 2, size[1] // 3)):
        values[pixel] = 1e-6
        rows, columns = values.nonzero().T
        left, top = int(columns.min()), int(rows.min())
        assert _native.box_of_nonzero(values) == (left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top)


@pytest.mark.parametrize("size", [(0, 5), (1, 1), (40, 130)])
def test_mean_squared_difference(isa: str, size: tuple[int, int]) -> None:
    """The mean squared difference agrees with float64."""
    image, picture = random(*size, 3), (255 * random(*size, 3, seed=1).sigmoid()).to(torch.uint8)
    expected = (image.double() - picture.double() / 255).square().sum() / max(image.numel(), 1)
    assert _native.mean_squared_difference(image, picture) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 130), (200, 301)])
def test_the_loss_of_alpha(isa: str, size: tuple[int, int]) -> None:
    """Value and gradient agree with PyTorch's in float64. Where alpha is the matte, the gradient is 0."""
    alpha, matte = random(*size).sigmoid(), (255 * random(*size, seed=1).sigmoid()).to(torch.uint8)
    alpha[0] = matte[0].float() * (1 / 255)
    own, exact = alpha.clone().requires_grad_(), alpha.double().requires_grad_()
    loss, expected = 2 * alpha_loss(own, matte, 0.7), 2 * alpha_loss_reference(exact, matte, 0.7)
    torch.autograd.backward([loss, expected])
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-5, abs=1e-7)
    assert own.grad is not None
    assert exact.grad is not None
    assert not own.grad[0].any()
    torch.testing.assert_close(own.grad[1:].double(), exact.grad[1:], rtol=1e-5, atol=0)


def test_the_same_bits_for_any_number_of_threads() -> None:
    """The number of threads does not change a bit."""
    values, gradient = random(20_000, 3), random(20_000, 3, seed=1)
    before, results = _native.thread_count(), []
    for threads in (1, 2, 3):
        _native.set_thread_count(threads)
        update = Update(values.clone(), gradient, Moments.zeros(values), 0.1)
        update_all([update])
        results.append((update.values, update.moments.first, update.moments.second))
    _native.set_thread_count(before)
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))


def test_another_epsilon_is_that_of_the_formula() -> None:
    """The core has one epsilon. An update with another is made in PyTorch, and is as small as the formula says."""
    for epsilon, moved in ((1e-15, 0.1), (1e-8, 0.1 / 11), (1e-9, 0.05)):
        values = torch.zeros(3)
        gradient = torch.full((3,), 1e-9)
        update_all([Update(values, gradient, Moments.zeros(values), 0.1, epsilon)])
        torch.testing.assert_close(values, torch.full((3,), -moved), rtol=1e-4, atol=0)
