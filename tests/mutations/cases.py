"""The mutations, read from cases.toml."""

import tomllib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Case:
    """One mutation."""

    file: str
    """Path in the project."""
    old: str
    """The text, which is in the file exactly once."""
    new: str
    """The text that takes its place."""
    tests: tuple[str, ...]
    """Files of tests that should catch it, without folder and ending."""


def read_cases() -> list[Case]:
    """Read all mutations."""
    content = tomllib.loads(Path(__file__).with_name("cases.toml").read_text(encoding="utf-8"))
    return [Case(**{**entry, "tests": tuple(entry["tests"])}) for entry in content["case"]]
