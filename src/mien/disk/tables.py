"""Tables of text: csv as programs and spreadsheets write it."""

import csv
import io
import json
from collections.abc import Iterator
from typing import IO

from mien.disk.reading import short_lines

_MAX_HEADING = 65_536
"""Largest number of characters of the first line that decide what separates the columns."""
_MAX_LINE = 1 << 20
"""Most characters of a line."""
_CELL_BYTES, _SHORT_CELL_BYTES, MAX_CELLS_BYTES = 72, 8, 5 << 28
"""Memory that the text of a cell takes, also of one character, and most memory that all may take, in bytes."""


def text_of(content: bytes) -> str:
    """The text of a file: UTF-16 or UTF-32 if it begins with their mark or with their zeros, else UTF-8.

    Raises:
        ValueError: it is none of these.
    """
    try:
        return content.decode(json.detect_encoding(content)).removeprefix("\ufeff")
    except UnicodeDecodeError:
        raise ValueError(_NO_TEXT) from None


def table_rows(file: IO[bytes] | io.BytesIO) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a csv that are not empty, each with the number of its last line. The first is the heading.

    Commas, semicolons or tabs separate cells, as in the heading. Excel's hint before it ("sep=;") is no row.

    Args:
        file: the csv, in an encoding that `text_of` knows.

    Raises:
        ValueError: it is no text, or has lines or cells that would take too much memory.
        csv.Error: it is no csv.
    """
    encoding = json.detect_encoding(file.read(4))
    file.seek(0)
    taken = 0
    try:
        with io.TextIOWrapper(file, encoding=encoding, newline="") as text:
            heading = next(
                (line for line in iter(lambda: text.readline(_MAX_HEADING), "") if not _is_skipped(line)), ""
            )
            text.seek(0)
            reader = csv.reader(short_lines(text, _MAX_LINE), delimiter=max(",;\t", key=heading.count))
            for row in reader:
                if not any(cell.strip() for cell in row) or (not taken and _is_skipped(row[0])):
                    continue
                # Texts of one character take no memory of their own.
                taken += len(row) * (_CELL_BYTES if sum(map(len, row)) > len(row) else _SHORT_CELL_BYTES)
                if taken > MAX_CELLS_BYTES:
                    raise ValueError("it has too many values; cut it into shorter tables")
                yield reader.line_num, row
    except UnicodeDecodeError:
        raise ValueError(_NO_TEXT) from None


def with_point(number: str) -> str:
    """The text of a number, with a decimal comma as a point."""
    return number.replace(",", ".") if number.count(",") == 1 and "." not in number else number


_NO_TEXT = "it is no text in UTF-8 or UTF-16; save it as UTF-8"


def _is_skipped(line: str) -> bool:
    """Whether a line before the heading is empty, or Excel's hint."""
    text = line.strip('\ufeff \t\r\n"').lower()
    return not text or text.startswith("sep=")
