"""Every row and every paragraph of docs/paper_preset.md is held by something: a place in a paper, or a test."""

import re
from pathlib import Path

import pytest

from paper_preset_facts import FACTS
from paper_preset_page import digest, paragraphs, rows_of
from paper_preset_register import HELD

TESTS = {
    name
    for path in Path(__file__).parent.glob("test_*.py")
    for name in re.findall(r"^def (test_\w+)\(", path.read_text(), flags=re.MULTILINE)
}


@pytest.mark.parametrize("method", FACTS)
def test_rows_say_what_is_published(method: str) -> None:
    """The column "paper", and why mien differs."""
    expected = {name: (row.published, row.why) for name, row in FACTS[method].items()}
    assert {name: (paper, why) for name, (paper, _, why) in rows_of(method).items()} == expected


@pytest.mark.parametrize("method", FACTS)
def test_rows_that_say_the_same_have_equal_numbers(method: str) -> None:
    """A row without a reason differs in nothing: the first number of the paper is that of the column "here"."""
    for name, (paper, here, why) in rows_of(method).items():
        published, ours = re.findall(r"[\d.,]*\d(?:e-?\d+)?", paper), re.findall(r"[\d.,]*\d(?:e-?\d+)?", here)
        if not why and published and ours and "not stated" not in paper and "code" not in paper:
            assert set(map(_number, published)) & set(map(_number, ours)), (name, paper, here)


def test_every_row_has_its_place_and_tests_that_exist() -> None:
    for method, rows in FACTS.items():
        for name, row in rows.items():
            assert row.place, (method, name)
            missing = [test for test in row.held.split() if test not in TESTS]
            assert not missing, (method, name, missing)
            assert row.held == "" or row.why, (method, name, "nothing to hold")


def test_every_paragraph_is_held_by_tests_that_exist() -> None:
    """Who changes a paragraph says in `paper_preset_register.py` which tests hold it, and gives its new digest."""
    unknown = {digest(text): text for text in paragraphs() if digest(text) not in HELD}
    assert not unknown, "no test is named that holds these paragraphs"
    gone = HELD.keys() - {digest(text) for text in paragraphs()}
    assert not gone, "these are no paragraphs of the page any more"
    for key, held in HELD.items():
        assert held.split(), f"{key}: nothing holds it"
        assert not [test for test in held.split() if test not in TESTS], key


def _number(text: str) -> float:
    return float(text.replace(",", ""))
