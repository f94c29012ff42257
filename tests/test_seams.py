"""Mutations and the stub of the native module fit the code, and calls are checked. The guard finds inexact
arithmetic, and everything that must be the same everywhere passes it."""

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

import mien
from checked_types import unchecked
from exact_guard import InexactError, exact_guard
from mien import _native
from mien.avatar.methods import DEFAULT_METHOD
from mien.machine import exact
from mien.rotation import skew
from mien.training import trainer
from mutations.copies import Case, read_cases
from plain_settings import plain_config, plain_run
from toy_scene import toy_data, toy_sequence

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("case", read_cases(), ids=lambda case: f"{case.file}: {case.old[:30]}")
def test_a_mutation_changes_one_place_and_names_tests_that_exist(case: Case) -> None:
    """Code that moves would let `make mutate` test nothing."""
    assert (ROOT / case.file).read_text(encoding="utf-8").count(case.old) == 1
    assert case.new != case.old
    assert all((ROOT / f"tests/{name}.py").is_file() for name in case.tests)


def test_a_wrong_type_is_found_where_calls_are_checked() -> None:
    integers = torch.zeros(2, 3, dtype=torch.int64)
    with unchecked():
        skew(integers)
    pytest.raises(TypeCheckError, skew, integers)


def test_the_stub_lists_what_the_native_module_has() -> None:
    body = ast.parse(Path(mien.__file__).with_name("_native.pyi").read_text()).body
    functions = {node.name: node.args.args for node in body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: fields(node.body) for node in body if isinstance(node, ast.ClassDef)}
    assert {*functions, *classes, *fields(body)} == {name for name in dir(_native) if not name.startswith("_")}
    for name, own in classes.items():
        assert own == list(getattr(getattr(_native, name), "_fields", ())), name
        assert len(own) <= 10
    for name, given in functions.items():
        signature = getattr(_native, name).__doc__.splitlines()[0]
        assert all(f"{one.arg}: " in signature for one in given), signature
        assert signature.count(": ") == len(given), signature


def fields(body: list[ast.stmt]) -> list[str]:
    """Return the names that a module or class declares with a type."""
    declared = (one.target for one in body if isinstance(one, ast.AnnAssign))
    return [target.id for target in declared if isinstance(target, ast.Name)]


T, A = torch.ones(5, 5), np.ones((5, 5))
LEARNT = torch.ones(5, 5, requires_grad=True)
INEXACT = (
    lambda: T @ T, lambda: LEARNT.matmul(T), lambda: torch.einsum("ij,jk->ik", T, T), lambda: torch.linalg.svd(T),
    lambda: T.sum(), lambda: T.softmax(-1), lambda: torch.conv2d(T[None, None], T[None, None, :2, :2]),
    lambda: A @ A, lambda: np.dot(A, A), lambda: A.dot(A), lambda: np.einsum("ij,jk->ik", A, A),
    lambda: np.linalg.norm(A[0]), lambda: np.polyfit(np.arange(5), A[0], 1), lambda: cv2.gemm(A, A, 1.0, A, 0.0),
)  # fmt: skip


@pytest.mark.exact
def test_the_guard_refuses_what_has_several_orders_and_lets_pass_what_has_one():
    for inexact in INEXACT:
        with pytest.raises(InexactError), exact_guard():
            inexact()
        inexact()  # all is as before
    with exact_guard():
        assert torch.equal(T * 2 + T, 3 * T)
        assert (float((T[:, :3] * T[:, :3]).sum(-1)[0]), exact.product(A, A)[0, 0]) == (3, 5)
        assert A.sum() == 25


@pytest.mark.exact
def test_a_step_of_training_adds_up_by_itself():
    """From the pose to the optimiser. The first step fills the caches."""
    face_model, sequence = toy_sequence(timesteps=3, size=32)
    settings = plain_run(steps=100, split="none", background="random", record_every=100)
    state = trainer.start([sequence], face_model, plain_config(DEFAULT_METHOD), settings, torch.zeros(()))
    data = toy_data(sequence, settings)
    trainer.step(state, data, settings)
    with exact_guard():
        trainer.step(state, data, settings)
