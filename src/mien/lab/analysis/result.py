"""Hold the results of a part of an analysis (values, tables, charts, pictures, films), and store them as json."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mien.pages.plots import Axes, Series, thin


@dataclass(frozen=True)
class Table:
    """Rows of figures. A cell is a text, a number or None."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str | float | int | None, ...], ...]
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Chart:
    """A line chart. It is drawn on the page and as NAME.png."""

    name: str
    """Name of the file without ending; unique in the analysis."""
    title: str
    series: tuple[Series, ...]
    axes: Axes
    caption: str = ""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture, written as NAME.png."""

    name: str
    """Name of the file without ending; unique in the analysis."""
    image: UInt8[np.ndarray, "_ _ 3"]
    caption: str


@dataclass(frozen=True)
class Film:
    """A video that the part has written into the analysis' folder."""

    file: str
    """Name of the .mp4 in the folder."""
    caption: str


@dataclass(frozen=True, eq=False)
class PartResult:
    """The result of a part."""

    values: Mapping[str, Any]
    """Figures for programs, as json can hold them."""
    findings: tuple[str, ...] = ()
    """The result in a sentence or two."""
    tables: tuple[Table, ...] = ()
    charts: tuple[Chart, ...] = ()
    pictures: tuple[Picture, ...] = ()
    films: tuple[Film, ...] = ()
    notes: tuple[str, ...] = field(default=())
    """How it was measured, and what limits the comparison."""

    def content(self) -> dict[str, Any]:
        """The result as json. Charts and pictures name their files; charts also hold their values."""
        return {
            "values": dict(self.values),
            "findings": list(self.findings),
            "tables": [asdict(table) for table in self.tables],
            "charts": [_chart_content(chart) for chart in self.charts],
            "pictures": [{"file": f"{one.name}.png", "caption": one.caption} for one in self.pictures],
            "films": [asdict(film) for film in self.films],
            "notes": list(self.notes),
        }


def file_names(content: Mapping[str, Any]) -> list[str]:
    """The names of all files that the content of a part names."""
    return [entry["file"] for kind in ("charts", "pictures", "films") for entry in content[kind]]


def chart_from(content: Mapping[str, Any]) -> Chart:
    """The chart of an entry of `PartResult.content`."""
    series = tuple(
        Series(one["label"], _array(one["x"]), _array(one["y"]), one["style"], bool(one["points"]))
        for one in content["series"]
    )
    axes = Axes(**{**content["axes"], "shaded": tuple(tuple(span) for span in content["axes"]["shaded"])})
    return Chart(Path(content["file"]).stem, content["title"], series, axes, content["caption"])


def _chart_content(chart: Chart) -> dict[str, Any]:
    series = []
    for one in chart.series:
        x, y = (one.x, one.y) if one.points else thin(one.x, one.y)
        series.append({**asdict(one), "x": _numbers(x), "y": _numbers(y)})
    named = {"file": f"{chart.name}.png", "title": chart.title, "caption": chart.caption}
    return {**named, "axes": asdict(chart.axes), "series": series}


def _numbers(values: np.ndarray) -> list[float | None]:
    """The values with six significant digits; NaN, which json does not have, becomes None."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in values.tolist()]


def _array(values: list[float | None]) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], np.float64)
