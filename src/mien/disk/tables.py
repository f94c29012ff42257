"""Tables of text: csv as programs and spreadsheets write it."""

import csv
import io
import json
from collections.abc import Iterator
from typing import IO

_MAX_LINE = 1 << 20
"""Most characters of a line."""
_CELL_BYTES, _SHORT_CELL_BYTES, MAX_CELLS_BYTES = 72, 8, 5 << 28
"""Memory that the text of a cell takes, also of one character, and most memory that all may take, in bytes."""


def text_of(content: bytes) -> str:
    """The text of a file: UTF-16 or UTF-32 if it begins with their mark or with their zeros, else UTF-8."""
    try:
        return content.decode(json.detect_encoding(content)).removeprefix("\ufeff")
    except UnicodeDecodeError:
        raise ValueError(_NO_TEXT) from None


def table_rows(file: IO[bytes] | io.BytesIO) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a csv that are not empty, each with the number of its last line. The first is the heading.

    A ValueError or csv.Error says that it is no text or no csv, or would take too much memory.
    """
    taken = 0
    for number, row in split_lines(file):
        if not any(cell.strip() for cell in row):
            continue
        # Texts of one character take no memory of their own.
        taken += len(row) * (_CELL_BYTES if sum(map(len, row)) > len(row) else _SHORT_CELL_BYTES)
        if taken > MAX_CELLS_BYTES:
            raise ValueError("it has too many values; cut it into shorter tables")
        yield number, row


def split_lines(file: IO[bytes] | io.BytesIO, most: int = _MAX_LINE) -> Iterator[tuple[int, list[str]]]:
    """Yield all rows of a csv, also empty ones, each with the number of its last line, and close the file.

    Commas, semicolons or tabs separate cells, as in the first line. Excel's hint before it ("sep=;") is no row. A line
    has at most `most` characters.
    """
    encoding, begun = json.detect_encoding(file.read(4)), False
    file.seek(0)
    try:
        with io.TextIOWrapper(file, encoding=encoding, newline="") as text:
            lines = iter(lambda: text.readline(1 << 16), "")
            heading = next((line for line in lines if line.strip() and not _is_hint(line)), "")
            text.seek(0)
            reader = csv.reader(_short_lines(text, most), delimiter=max(",;\t", key=heading.count))
            for row in reader:
                if begun or not row or not _is_hint(row[0]):
                    yield reader.line_num, row
                begun = begun or bool(row)
    except UnicodeDecodeError:
        raise ValueError(_NO_TEXT) from None


def _short_lines(file: io.TextIOWrapper, most: int) -> Iterator[str]:
    """The lines of a text. csv holds a line in memory many times over."""
    while line := file.readline(most):
        if len(line) == most:
            raise ValueError(f"a line has more than {most:,} characters")
        yield line


def with_point(number: str) -> str:
    """The text of a number, with a decimal comma as a point."""
    return number.replace(",", ".") if number.count(",") == 1 and "." not in number else number


_NO_TEXT = "it is no text in UTF-8 or UTF-16; save it as UTF-8"


def _is_hint(line: str) -> bool:
    """Whether a line before the heading is Excel's hint."""
    return line.strip('\ufeff \t\r\n"').lower().startswith("sep=")
