"""The network of blended features, and the update of its bases. tests/test_training_native.py has their twins."""

import pytest
import torch
from torch import Tensor

from known import known
from mien import _native
from mien.adam import FactoredGradient, FactoredMoments, Moments
from mien.avatar.ops.feature_network import Layers, feature_network, network_outputs
from mien.training.adam import (
    FactoredUpdate,
    Update,
    factored_update,
    update_all,
)
from toy_scene import random

Sizes = tuple[int, int, int, int, int, int]
"""Gaussians, inputs, features, own numbers, hidden values, outputs."""
SIZES: list[Sizes] = [
    (100, 20, 32, 27, 64, 49), (1, 1, 1, 0, 1, 1), (0, 3, 4, 5, 6, 7), (2000, 5, 17, 3, 70, 5), (97, 3, 8, 27, 33, 4),
]  # fmt: skip


def arguments(sizes: Sizes, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Bases, inputs, neutral features, own numbers and layers. One input is 0."""
    n, k, f, x, h, o = sizes
    inputs = random(k, seed=1)
    inputs[k // 2 :: 7] = 0
    made = [
        random(n, k, f), inputs, random(n, f, seed=2), random(n, x, seed=3), random(h, f + x, seed=4) / 4,
        random(h, seed=5), random(o, h, seed=6) / 4, random(o, seed=7),
    ]  # fmt: skip
    return [tensor.to(dtype) for tensor in made]


def gradients_of(sizes: Sizes) -> tuple[Tensor, Tensor]:
    """Gradients of the outputs. Every third Gaussian has none."""
    others, last = random(sizes[0], sizes[5] - 1, seed=8), random(sizes[0], seed=9)
    others[::3], last[::3] = 0, 0
    return others, last


def ours(given: list[Tensor], by: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Outputs and gradients of `feature_network`, that of the bases multiplied out."""
    gradient = FactoredGradient()
    leaves = [tensor.clone().requires_grad_() for tensor in given]
    bases, inputs, neutral, own, *layers = leaves
    outputs = feature_network(bases, inputs, neutral, own, Layers(*layers), gradient)
    found = torch.autograd.grad(outputs, leaves[1:], [one.to(outputs[0]) for one in by])
    ((rows, columns),) = gradient.take()
    return [tensor.detach() for tensor in (*outputs, rows[:, None] * columns[:, None], *found)]


def theirs(given: list[Tensor], by: tuple[Tensor, Tensor]) -> list[Tensor]:
    """The same in float64 and plain PyTorch."""
    leaves = [tensor.double().requires_grad_() for tensor in given]
    bases, inputs, neutral, own, *layers = leaves
    outputs = network_outputs(neutral + torch.einsum("nkf,k->nf", bases, inputs), own, Layers(*layers))
    return [
        tensor.detach() for tensor in (*outputs, *torch.autograd.grad(outputs, leaves, [one.double() for one in by]))
    ]


def test_other_dtypes_have_factored_gradients_too() -> None:
    given, by = arguments(SIZES[0], torch.float64), gradients_of(SIZES[0])
    for own, expected in zip(ours(given, by), theirs(given, by), strict=True):
        torch.testing.assert_close(own, expected)


def test_gradients_are_the_same_whether_own_numbers_have_one_and_outputs_without_any(isa: str) -> None:
    given, by, found = arguments(SIZES[4]), gradients_of(SIZES[4]), []
    bases, _, _, own, *_ = given
    for wanted in (False, True):
        inputs, neutral, *layers = leaves = [given[i].clone().requires_grad_() for i in (1, 2, 4, 5, 6, 7)]
        own = own.clone().requires_grad_(wanted)
        outputs = feature_network(bases, inputs, neutral, own, Layers(*layers), FactoredGradient())
        found.append(torch.autograd.grad(outputs, leaves, by))
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))
    with torch.no_grad():
        bases, inputs, neutral, own, *layers = given
        alone = feature_network(bases, inputs, neutral, own, Layers(*layers), FactoredGradient())
    assert all(torch.equal(a, b) for a, b in zip(alone, ours(given, by), strict=False))


def test_bases_may_lie_in_memory_in_either_order(isa: str) -> None:
    bases, inputs, neutral, own, *layers = arguments(SIZES[4])
    network = _native.FeatureNetwork(neutral, own, *layers)

    def outputs(*groups: _native.FeatureBases) -> tuple[Tensor, Tensor]:
        others, last = torch.empty(len(neutral), len(layers[-1]) - 1), torch.empty(len(neutral))
        _native.feature_network(network, groups, None, others, last)
        return others, last

    by_gaussian = _native.FeatureBases(bases[:, :2].contiguous(), inputs[:2], by_input=False)
    by_input = _native.FeatureBases(bases[:, 2:].transpose(0, 1).contiguous(), inputs[2:], by_input=True)
    together = _native.FeatureBases(bases, inputs, by_input=False)
    for groups in ((by_gaussian, by_input), (by_input, by_gaussian)):
        torch.testing.assert_close(outputs(*groups), outputs(together), rtol=1e-5, atol=1e-6)


def update_of(dtype: torch.dtype = torch.float32, n: int = 2000, k: int = 5, f: int = 19) -> FactoredUpdate:
    rows, columns = random(n, f, seed=1), random(k, seed=2)
    rows[::3], columns[1] = 0, 0
    moments = FactoredMoments(0.1 * random(n, f, seed=3).square(), random(n, seed=4).square() / 10)
    moments.weights[1::2], moments.second[1::2] = 0, 0  # rows without an update so far
    tensors = [tensor.to(dtype) for tensor in (random(n, k, f), rows, columns, moments.second, moments.weights)]
    return FactoredUpdate(tensors[0], [(tensors[1], tensors[2])], FactoredMoments(*tensors[3:]), 0.01)


def test_first_update_of_a_row_moves_by_about_the_rate_and_rows_without_gradient_stay() -> None:
    update = update_of(torch.float64)
    before, columns = update.values.clone(), update.terms[0][1]
    assert isinstance(update.moments, FactoredMoments)
    second, weights = update.moments.second.clone(), update.moments.weights.clone()
    factored_update(update)
    moved = (update.values - before)[1::6].abs()  # no update so far, and a gradient now
    expected = update.rate * columns.abs() / columns.square().mean().sqrt()
    torch.testing.assert_close(moved, expected[:, None].expand_as(moved))
    assert torch.equal(update.values[::3], before[::3])
    assert torch.equal(update.values[:, 1], before[:, 1])
    assert torch.equal(update.moments.second[::3], second[::3])
    assert torch.equal(update.moments.weights[::3], weights[::3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_move_against_gradients_of_either_sign(dtype: torch.dtype) -> None:
    """A first update moves by the rate, also where all gradients of a row have the same sign."""
    values, rows = torch.zeros(3, 1, 2, dtype=dtype), torch.tensor([[-1.0, -2], [1, 2], [0, 0]], dtype=dtype)
    moments = FactoredMoments.zeros(values)
    factored_update(FactoredUpdate(values, [(rows, torch.ones(1, dtype=dtype))], moments, 0.01))
    expected = torch.tensor([[0.01, 0.01], [-0.01, -0.01], [0, 0]], dtype=dtype)
    torch.testing.assert_close(values[:, 0], expected, rtol=1e-5, atol=0)
    assert (moments.weights > 0).tolist() == [True, True, False]


def test_terms_add_up_and_those_that_cancel_leave_everything_finite(isa: str) -> None:
    one, parts, update = update_of(torch.float64), update_of(torch.float64), update_of()
    ((rows, columns),) = parts.terms
    factored_update(one)
    factored_update(parts._replace(terms=[(0.25 * rows, columns), (rows, 0.75 * columns)]))
    torch.testing.assert_close(one.values, parts.values)
    ((rows, columns),) = update.terms
    factored_update(update._replace(terms=[(rows, columns), (-rows * (1 - 1e-7), columns)]))
    assert update.values.isfinite().all()
    assert (update.moments.second >= 0).all()


def published(dtype: torch.dtype, f: int, terms: int) -> FactoredUpdate:
    """An update by Adam as published, at its fourth step."""
    one = update_of(dtype, f=f)
    n, k, _ = one.values.shape
    first, second = random(n, k, f, seed=5).to(dtype), (random(n, k, f, seed=6).square() + 0.1).to(dtype)
    more = [(random(n, f, seed=7 + t).to(dtype), random(k, seed=9 + t).to(dtype)) for t in range(terms - 1)]
    return FactoredUpdate(one.values, [*one.terms, *more], Moments(first, second, torch.tensor(3.0)), one.rate)


def test_published_update_has_the_bits_of_adam_with_the_whole_gradient(isa: str) -> None:
    factored, whole = published(torch.float32, 19, 1), published(torch.float32, 19, 1)
    ((rows, columns),) = whole.terms
    factored_update(factored)
    assert isinstance(whole.moments, Moments)
    update_all([Update(whole.values, rows[:, None] * columns[:, None], whole.moments, whole.rate)])
    assert factored.values.equal(whole.values)
    assert all(getattr(factored.moments, n).equal(getattr(whole.moments, n)) for n in ("first", "second", "step"))


def test_gradients_of_neutral_features_share_memory_until_a_second_backward_pass() -> None:
    """Autograd adds the second gradient to the first one in place, which must not change the first term."""
    leaves, gradient = [tensor.clone().requires_grad_() for tensor in arguments(SIZES[0])], FactoredGradient()
    bases, inputs, neutral, own, *layers = leaves
    for number in range(2):
        outputs = feature_network(bases, inputs.detach(), neutral, own, Layers(*layers), gradient)
        torch.autograd.backward(outputs, gradients_of(SIZES[0]))
        shared = known(neutral.grad)
        assert (shared.data_ptr() == gradient.terms[0][0].data_ptr()) is (number == 0)
    (first, _), (second, _) = gradient.take()
    assert first.equal(second)
    assert float(first.abs().sum()) > 0
    assert known(neutral.grad).equal(first + second)
