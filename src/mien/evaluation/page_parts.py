"""Parts of report.html, compare.html and analysis.html: tables, pictures and videos."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from mien.evaluation.metrics_file import figure
from mien.media.pictures import data_uri, picture_uri, shrink
from mien.pages.pages import COLUMNS

_MAX_EMBEDDED_BYTES = 6 << 20


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    kind: str = ""
    """CSS classes: `head` starts a group of columns, `group` is the name of one, `left` is aligned to the left."""
    columns: int = 1
    """How many columns it spans."""
    best: bool = False
    """Whether it is the best of its column, in bold."""
    lead: str = ""
    """A lead over other rows, shown small after the text."""


@dataclass(frozen=True)
class DataTable:
    """A table of text and figures."""

    head: Sequence[Sequence[Cell]]
    """Rows of headings."""
    rows: Sequence[Sequence[Cell]]
    note: str = ""
    """Text below the table."""
    own: bool = False
    """Whether the first row is the subject of the page, in bold."""


@dataclass(frozen=True)
class Picture:
    """A picture in a page."""

    what: str
    """Its text for readers who do not see it."""
    source: str
    """Data URI."""
    caption: str = ""


@dataclass(frozen=True)
class Card:
    """A chart with a title."""

    title: str
    chart: Markup
    caption: str = ""


@dataclass(frozen=True)
class Video:
    """A video in a page: embedded if it is small, so that the page stays one file, or else linked."""

    source: str
    """Data URI or link."""
    link: str
    """Path from the page's folder."""
    note: str


def metric_headings(crops: int | None = None) -> list[Cell]:
    """The heading cells of all metrics, for the whole frame and then for the head crop, or for a number of crops."""
    names = [f"{name} {'↑' if higher else '↓'}" for _, name, _, higher in COLUMNS]
    crop = [Cell(name, "head" if index == 0 else "") for index, name in enumerate(names)]
    return [*map(Cell, names), *crop] if crops is None else crops * crop


def metric_groups() -> list[Cell]:
    """The cells above `metric_headings`."""
    return [Cell("Whole frame", "group", len(COLUMNS)), Cell("Head crop", "group head", len(COLUMNS))]


def metric_cells(
    entry: Mapping[str, Any],
    parts: Sequence[str | None],
    best: Callable[[str | None, str, bool], float | None] = lambda *_: None,
) -> list[Cell]:
    """The figures of a row, in the columns of `metric_headings`.

    Of `parts`, None is the whole frame. `best` returns the best rounded figure of a column, by crop, metric and whether
    higher is better.
    """
    cells = []
    for part in parts:
        for index, (metric, _, digits, higher) in enumerate(COLUMNS):
            value = figure(entry, part, metric)
            wins = value is not None and round(value, digits) == best(part, metric, higher)
            cells.append(Cell(figure_text(value, digits), "head" if part and index == 0 else "", best=wins))
    return cells


def figure_text(value: float | int | None, digits: int) -> str:
    """A figure of a table. A missing one is a dash."""
    return "–" if value is None else f"{value:.{digits}f}"


def picture_of(picture: UInt8[np.ndarray, "_ _ 3"], what: str, max_side: int, caption: str = "") -> Picture:
    """A picture whose longer side has at most `max_side` pixels. `what` is its text for readers who do not see it."""
    return Picture(what, picture_uri(shrink(picture, max_side)), caption)


def video_of(path: Path, page_folder: Path, note: str) -> Video:
    """A video in or below the page's folder."""
    link = path.relative_to(page_folder).as_posix()
    is_small = path.stat().st_size <= _MAX_EMBEDDED_BYTES
    return Video(data_uri("video/mp4", path.read_bytes()) if is_small else link, link, note)
