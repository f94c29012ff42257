"""The result of a part of an analysis: values, tables, charts, pictures and films, as json and as a section of a page.

The section is made from the json, so that a part that was computed before looks the same again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup

from mien.disk.reading import inside, read_bytes
from mien.evaluation.page_parts import Card, Cell, DataTable, video_of
from mien.evaluation.page_parts import Picture as PagePicture
from mien.media.picture_files import write_png
from mien.media.pictures import data_uri
from mien.pages.pages import Axes, Series, line_chart, render, thin, write_chart


@dataclass(frozen=True)
class Table:
    """Rows of figures. A cell is a text, a number or None."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | int | None]]
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Chart:
    """A line chart. It is drawn on the page and as NAME.svg; the name is unique in the analysis."""

    name: str
    title: str
    series: Sequence[Series]
    axes: Axes
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture, written as NAME.png; the name is unique in the analysis."""

    name: str
    image: UInt8[np.ndarray, "_ _ 3"]
    caption: str


@dataclass(frozen=True)
class Film:
    """A video that the part has written into the analysis' folder."""

    file: str
    caption: str


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a part."""

    values: Mapping[str, Any]
    """Figures for programs, as json can hold them."""
    findings: Sequence[str] = ()
    """The result in a sentence or two."""
    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    pictures: Sequence[Picture] = ()
    films: Sequence[Film] = ()
    notes: Sequence[str] = ()
    """How it was measured, and what limits the comparison."""

    def write(self, folder: Path) -> dict[str, Any]:
        """Write charts and pictures into a folder, and return the result as json, which names their files."""
        for chart in self.charts:
            write_chart(folder / f"{chart.name}.svg", [(chart.title, chart.series, chart.axes)])
        for picture in self.pictures:
            write_png(folder / f"{picture.name}.png", picture.image)
        return {
            "values": dict(self.values), "findings": list(self.findings),
            "tables": [asdict(table) for table in self.tables],
            "charts": [_chart_content(chart) for chart in self.charts],
            "pictures": [{"file": f"{one.name}.png", "caption": one.caption} for one in self.pictures],
            "films": [asdict(film) for film in self.films], "notes": list(self.notes),
        }  # fmt: skip


def section_html(title: str, part: Mapping[str, Any], folder: Path) -> Markup:
    """The section of a part on the page, from its json and from the pictures and films in `folder`."""
    return render(
        "lab/analysis/templates/section.html",
        title=title,
        findings=part["findings"],
        tables=[_table(table) for table in part["tables"]],
        charts=[_card(entry) for entry in part["charts"]],
        pictures=[
            PagePicture(entry["caption"], data_uri("image/png", read_bytes(inside(folder, entry["file"]), 64 << 20)))
            for entry in part["pictures"]
        ],
        films=[video_of(inside(folder, entry["file"]), folder, entry["caption"]) for entry in part["films"]],
        notes=part["notes"],
    )


def _chart_content(chart: Chart) -> dict[str, Any]:
    series = []
    for one in chart.series:
        x, y = (one.x, one.y) if one.points else thin(one.x, one.y)
        series.append({**asdict(one), "x": _numbers(x), "y": _numbers(y)})
    named = {"file": f"{chart.name}.svg", "title": chart.title, "caption": chart.caption}
    return {**named, "axes": asdict(chart.axes), "series": series}


def _numbers(values: np.ndarray) -> list[float | None]:
    """The values with six significant digits; NaN, which json does not have, becomes None."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]


def _card(entry: Mapping[str, Any]) -> Card:
    series = [Series(**{**one, **{axis: np.array(one[axis], np.float64) for axis in "xy"}}) for one in entry["series"]]
    return Card(entry["title"], line_chart(series, Axes(**entry["axes"])), entry["caption"])


def _table(table: Mapping[str, Any]) -> DataTable:
    head = [Cell(name) for name in table["columns"]]
    return DataTable([head], [[Cell(_text(cell)) for cell in row] for row in table["rows"]], table["caption"])


def _text(cell: str | float | int | None) -> str:
    if cell is None:
        return "–"
    return cell if isinstance(cell, str) else f"{cell:,}"
