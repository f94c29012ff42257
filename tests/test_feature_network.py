"""The network of blended features, and the update of its bases. tests/test_training_native.py has their twins."""

import pytest
import torch
from torch import Tensor

from known import known
from mien.adam import FactoredGradient, FactoredMoments, FactoredTerm, Moments
from mien.avatar.ops.feature_network import Layers, feature_network, network_outputs
from mien.training.adam import FactoredUpdate, Update, factored_update, update_all
from toy_scene import random

Sizes = tuple[int, int, int, int, int, int, int]
"""Gaussians, inputs, features, own numbers, hidden values, outputs, rows of inputs (0: all take the same)."""
SIZES: list[Sizes] = [
    (100, 20, 32, 27, 64, 49, 0), (1, 1, 1, 0, 1, 1, 1), (0, 3, 4, 5, 6, 7, 2), (2000, 5, 17, 3, 70, 5, 0),
    (97, 3, 8, 27, 33, 4, 0), (300, 20, 40, 0, 64, 4, 7),
]  # fmt: skip


def table(rows: int, k: int, seed: int) -> Tensor:
    """Numbers for all Gaussians [k], or a table of rows, of which the first is 0."""
    made = random(*[rows][: bool(rows)], k, seed=seed)
    made[..., k // 2 :: 7] = 0
    made[:1] *= rows == 0
    return made


def places(inputs: Tensor, n: int) -> Tensor | None:
    """The row of each Gaussian in a table, or None if all take the same inputs."""
    return None if inputs.ndim == 1 else 5 * torch.arange(n) % len(inputs)


def product(rows: Tensor, columns: Tensor, places: Tensor | None = None) -> Tensor:
    """A term of a factored gradient, multiplied out."""
    return rows[:, None] * (columns if places is None else columns[places])[..., None]


def arguments(sizes: Sizes, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """Bases, inputs, neutral features, own numbers and layers. One input is 0."""
    n, k, f, x, h, o, rows = sizes
    inputs = table(rows, k, 1)
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
    leaves = [tensor.clone().requires_grad_(index != 1 or tensor.ndim == 1) for index, tensor in enumerate(given)]
    bases, inputs, neutral, own, *layers = leaves
    outputs = feature_network(bases, inputs, places(inputs, len(own)), neutral, own, Layers(*layers), gradient)
    wanted = [leaf for leaf in leaves[1:] if leaf.requires_grad]
    found = torch.autograd.grad(outputs, wanted, [one.to(outputs[0]) for one in by])
    (term,) = gradient.take()
    return [tensor.detach() for tensor in (*outputs, product(*term), *found)]


def theirs(given: list[Tensor], by: tuple[Tensor, Tensor]) -> list[Tensor]:
    """The same in float64 and plain PyTorch."""
    leaves = [tensor.double().requires_grad_() for tensor in given]
    bases, inputs, neutral, own, *layers = leaves
    each = inputs.expand(len(own), -1) if inputs.ndim == 1 else inputs[places(inputs, len(own))]
    outputs = network_outputs(neutral + torch.einsum("nkf,nk->nf", bases, each), own, Layers(*layers))
    wanted = [leaf for leaf in leaves if leaf is not inputs or inputs.ndim == 1]
    found = torch.autograd.grad(outputs, wanted, [one.double() for one in by])
    return [tensor.detach() for tensor in (*outputs, *found)]


@pytest.mark.parametrize("sizes", [SIZES[0], SIZES[-1]])
def test_other_dtypes_have_factored_gradients_too(sizes: Sizes) -> None:
    given, by = arguments(sizes, torch.float64), gradients_of(sizes)
    for own, expected in zip(ours(given, by), theirs(given, by), strict=True):
        torch.testing.assert_close(own, expected)


def test_gradients_are_the_same_whether_own_numbers_have_one_and_outputs_without_any(isa: str) -> None:
    given, by, found = arguments(SIZES[4]), gradients_of(SIZES[4]), []
    bases, _, _, own, *_ = given
    for wanted in (False, True):
        inputs, neutral, *layers = leaves = [given[i].clone().requires_grad_() for i in (1, 2, 4, 5, 6, 7)]
        own = own.clone().requires_grad_(wanted)
        outputs = feature_network(bases, inputs, None, neutral, own, Layers(*layers), FactoredGradient())
        found.append(torch.autograd.grad(outputs, leaves, by))
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))
    (bases, inputs, neutral, own, *layers), expected = given, ours(given, by)
    for rows in (None, torch.zeros(len(own), dtype=torch.int64)):
        alone = feature_network(bases, inputs[None], rows, neutral, own, Layers(*layers), FactoredGradient())
        assert all(map(torch.equal, alone, expected))


def update_of(dtype: torch.dtype = torch.float32, f: int = 19, table_rows: int = 0) -> FactoredUpdate:
    n, k = 2000, 5
    rows, columns = random(n, f, seed=1), table(table_rows, k, 2)
    rows[::3] = 0
    moments = FactoredMoments(0.1 * random(n, f, seed=3).square(), random(n, seed=4).square() / 10)
    moments.weights[1::2], moments.second[1::2] = 0, 0  # rows without an update so far
    tensors = [tensor.to(dtype) for tensor in (random(n, k, f), rows, columns, moments.second, moments.weights)]
    term = FactoredTerm(tensors[1], tensors[2], places(columns, n))
    return FactoredUpdate(tensors[0], [term], FactoredMoments(*tensors[3:]), 0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("table_rows", [0, 4])
def test_first_update_of_a_row_is_against_its_gradient_by_the_rate_and_rows_without_one_stay(
    dtype: torch.dtype, table_rows: int
) -> None:
    update = update_of(dtype, table_rows=table_rows)
    before, (factors, columns, rows) = update.values.clone(), update.terms[0]
    assert isinstance(update.moments, FactoredMoments)
    second, weights = update.moments.second.clone(), update.moments.weights.clone()
    factored_update(update)
    each = columns.expand(2000, 5) if rows is None else columns[rows]
    moved = (update.values - before)[1::6]  # no update so far, and a gradient now
    expected = -update.rate * each / each.square().mean(1, keepdim=True).sqrt().clamp_min(1e-9)
    torch.testing.assert_close(moved, (factors.sign()[:, None] * expected[..., None])[1::6], rtol=1e-4, atol=1e-6)
    still = (torch.arange(2000) % 3 == 0) | ~each.any(1)
    assert (still[1::3].any() and not still.all()) == (table_rows > 0)
    assert torch.equal(update.values[still], before[still])
    assert torch.equal(update.values[:, 2], before[:, 2])
    assert torch.equal(update.moments.second[still], second[still])
    assert torch.equal(update.moments.weights[still], weights[still])


def test_terms_add_up_and_those_that_cancel_leave_everything_finite(isa: str) -> None:
    one, parts, update = update_of(torch.float64), update_of(torch.float64), update_of()
    ((rows, columns, _),) = parts.terms
    factored_update(one)
    factored_update(parts._replace(terms=[FactoredTerm(0.25 * rows, columns), FactoredTerm(rows, 0.75 * columns)]))
    torch.testing.assert_close(one.values, parts.values)
    ((rows, columns, _),) = update.terms
    factored_update(update._replace(terms=[*update.terms, FactoredTerm(-rows * (1 - 1e-7), columns)]))
    assert update.values.isfinite().all()
    assert (update.moments.second >= 0).all()


def published(f: int, terms: int, table_rows: int, dtype: torch.dtype = torch.float32) -> FactoredUpdate:
    """An update by Adam as published, at its fourth step."""
    one = update_of(dtype, f, table_rows)
    n, k, _ = one.values.shape
    first, second = random(n, k, f, seed=5).to(dtype), (random(n, k, f, seed=6).square() + 0.1).to(dtype)
    more = [FactoredTerm(random(n, f, seed=7 + t).to(dtype), random(k, seed=9 + t).to(dtype)) for t in range(terms - 1)]
    return FactoredUpdate(one.values, [*one.terms, *more], Moments(first, second, torch.tensor(3.0)), one.rate)


@pytest.mark.parametrize("table_rows", [0, 4])
def test_published_update_has_the_bits_of_adam_with_the_whole_gradient(isa: str, table_rows: int) -> None:
    factored, whole = published(19, 1, table_rows), published(19, 1, table_rows)
    factored_update(factored)
    assert isinstance(whole.moments, Moments)
    update_all([Update(whole.values, product(*whole.terms[0]), whole.moments, whole.rate)])
    assert factored.values.equal(whole.values)
    assert all(getattr(factored.moments, n).equal(getattr(whole.moments, n)) for n in ("first", "second", "step"))


def test_gradients_of_neutral_features_share_memory_until_a_second_backward_pass() -> None:
    """Autograd adds the second gradient to the first one in place, which must not change the first term."""
    leaves, gradient = [tensor.clone().requires_grad_() for tensor in arguments(SIZES[0])], FactoredGradient()
    bases, inputs, neutral, own, *layers = leaves
    for number in range(2):
        outputs = feature_network(bases, inputs.detach(), None, neutral, own, Layers(*layers), gradient)
        torch.autograd.backward(outputs, gradients_of(SIZES[0]))
        assert (known(neutral.grad).data_ptr() == gradient.terms[0].rows.data_ptr()) is (number == 0)
    first, second = (term.rows for term in gradient.take())
    assert first.equal(second)
    assert float(first.abs().sum()) > 0
    assert known(neutral.grad).equal(first + second)
