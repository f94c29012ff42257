"""A comparison as aligned text, with the best figures in bold if the terminal can show that."""

from collections.abc import Sequence

from mien.evaluation.compare import COLUMNS, Comparison, Row, Table, figure
from mien.terminal import printable

_BOLD, _PLAIN = "\x1b[1m", "\x1b[0m"
_PARTS = ((None, "whole frame"), ("head", "head crop"))


def comparison_text(comparison: Comparison, bold: bool = False) -> str:
    """All tables, then the warnings."""
    parts = [_table_text(table, bold) for table in comparison.tables]
    parts += [printable(f"warning: {warning}") for warning in comparison.warnings]
    return "\n".join(parts)


def _table_text(table: Table, bold: bool) -> str:
    """A heading and an aligned table: first the whole frame, then the head crop."""
    sequences = ", ".join(sorted(set(table.rows[0].entry["per_frame"]["sequence"])))
    title = printable(f"{table.protocol}: {table.frames} frames held out of {sequences} ({table.split})")
    extra = ("Gaussians", "training", "ms/frame")
    heads = [
        "",
        "faces",
        *(heading for _, heading, _, _ in COLUMNS),
        *(heading for _, heading, _, _ in COLUMNS),
        *extra,
    ]
    lines = [[(text, False) for text in heads]]
    lines += [_cells(table, row) for row in table.rows]
    widths = [max(len(line[i][0]) for line in lines) for i in range(len(heads))]
    groups = " " * (sum(widths[:2]) + 4)
    count = len(COLUMNS)
    for index, (_, name) in enumerate(_PARTS):
        columns = widths[2 + index * count : 2 + (index + 1) * count]
        groups += f"{name:<{sum(columns) + 2 * count}}"
    body = "\n".join(_line(line, widths, bold) for line in lines)
    return f"{title}\n{groups.rstrip()}\n{body}\n"


def _cells(table: Table, row: Row) -> list[tuple[str, bool]]:
    """The texts of a row, each with whether it is the best of its column."""
    cells = [(printable(row.label), False), (printable(row.faces), False)]
    for part, _ in _PARTS:
        for metric, _, digits, higher in COLUMNS:
            value = figure(row.entry, part, metric)
            best = table.best(part, metric, higher) if row.run is not None else None
            text = "-" if value is None else f"{value:.{digits}f}"
            cells.append((text, best is not None and value is not None and round(value, digits) == best))
    if row.run is None:
        return cells + [("", False)] * 3
    training = row.run.metrics["training"]
    extra = (
        f"{training['gaussians']:,}",
        f"{training['seconds']:.0f} s",
        f"{1e3 * row.entry['seconds_per_frame']:.1f}",
    )
    return cells + [(text, False) for text in extra]


def _line(cells: Sequence[tuple[str, bool]], widths: Sequence[int], bold: bool) -> str:
    texts = []
    for index, ((text, best), width) in enumerate(zip(cells, widths, strict=True)):
        padded = f"{text:<{width}}" if index < 2 else f"{text:>{width}}"
        texts.append(f"{_BOLD}{padded}{_PLAIN}" if bold and best else padded)
    return "  ".join(texts).rstrip()
