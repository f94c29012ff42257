"""Read the page docs/paper_preset.md: its tables, and its paragraphs."""

import hashlib
import re
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
PAGE = DOCS / "paper_preset.md"
_HEAD = "| setting | paper | here | why different |"


def rows_of(method: str) -> dict[str, tuple[str, str, str]]:
    """The columns "paper", "here" and "why different" of a method's first table, by the names in its first column."""
    (own,) = [
        text for text in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE) if text.startswith(f"{method}\n")
    ]
    table = own[own.index(_HEAD) :].split("\n\n")[0].splitlines()[2:]
    rows = {}
    for line in table:
        name, paper, here, why = (cell.strip() for cell in line.removeprefix("|").removesuffix("|").split(" | "))
        rows[name.replace("`", "")] = (paper, here, why)
    return rows


def values_of(method: str) -> dict[str, str]:
    """The column "here" of a method's first table, by the names in its first column."""
    return {name: here for name, (_, here, _) in rows_of(method).items()}


def flat(text: str) -> str:
    """The text without its breaks of lines."""
    return " ".join(text.split())


def paragraphs() -> list[str]:
    """All blocks of the page between empty lines, but headings and the tables that `rows_of` reads."""
    blocks = [block for block in PAGE.read_text().split("\n\n") if block.strip()]
    return [block.strip() for block in blocks if not block.startswith(("#", _HEAD))]


def digest(paragraph: str) -> str:
    """Eight hex digits that change with every word and number of a paragraph."""
    return hashlib.sha256(flat(paragraph).encode()).hexdigest()[:8]
