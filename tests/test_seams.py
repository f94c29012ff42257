"""Mutations and the stub of the native module fit the code, and calls are checked."""

import ast
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

import mien
from checked_types import unchecked
from mien import _native
from mien.rotation import skew
from mutations.copies import Case, read_cases

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
