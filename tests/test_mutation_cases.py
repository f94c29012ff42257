"""The mutations of `make mutate` fit the code: code that moves would let them test nothing."""

from pathlib import Path

import pytest

from mutations.cases import Case, read_cases

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("case", read_cases(), ids=lambda case: f"{case.file}: {case.old[:30]}")
def test_a_mutation_changes_one_place_and_names_tests_that_exist(case: Case) -> None:
    """`old` is in its file exactly once, and each file of tests is there."""
    assert (ROOT / case.file).read_text(encoding="utf-8").count(case.old) == 1
    assert case.new != case.old
    known = {path.stem for path in ROOT.glob("tests/test_*.py")}
    assert set(case.tests) <= known
