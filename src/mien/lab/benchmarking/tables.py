"""Tables in markdown."""

from collections.abc import Iterable, Sequence


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in markdown. Each line ends with a line break."""
    lines = [" | ".join(heads), *(" | ".join(row) for row in rows)]
    lines = [f"| {line} |" for line in lines]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]]) + "\n"
