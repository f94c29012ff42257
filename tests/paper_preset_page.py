"""Read the tables of docs/paper_preset.md."""

import re
from pathlib import Path

PAGE = Path(__file__).parent.parent / "docs" / "paper_preset.md"


def values_of(method: str) -> dict[str, str]:
    """The column "here" of a method's first table in docs/paper_preset.md, by the names in its first column."""
    (own,) = [text for text in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE) if text.startswith(method)]
    table = own[own.index("| setting |") :].split("\n\n")[0].splitlines()[2:]
    rows = [line.removeprefix("| ").split(" | ") for line in table]
    return {cells[0].replace("`", ""): cells[2] for cells in rows}
