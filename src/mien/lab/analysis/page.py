"""analysis.html: one page for all parts. Charts, pictures and short films are inside it."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mien.disk.files import write_atomically
from mien.disk.inside import inside
from mien.disk.reading import read_bytes
from mien.evaluation.page_parts import Card, Cell, DataTable, Picture, video_of
from mien.lab.analysis.result import chart_from
from mien.lab.analysis.spec import Analysis
from mien.media.pictures import data_uri
from mien.pages.pages import render
from mien.pages.plots import line_chart

_MAX_PICTURE_BYTES = 64 << 20
"""Limit of a picture of the page, in bytes."""


def write_page(path: Path, analysis: Analysis, content: Mapping[str, Any]) -> None:
    """Write the page.

    Args:
        path: The .html file. Pictures and films are read from its folder.
        analysis: What was analysed.
        content: The content of analysis.json.
    """
    sections = [
        section_html(part.summary, content["parts"][part.name], path.parent)
        for part in analysis.parts
        if part.name in content["parts"]
    ]
    text = render(
        "lab/analysis/templates/analysis.html",
        title=f"{content['run']} · {analysis.method}",
        paper=content["paper"],
        version=content["mien"],
        command=shlex.join(["mien", *content["command_line"][1:]]),
        sections=sections,
    )
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def section_html(title: str, part: Mapping[str, Any], folder: Path) -> Markup:
    """The section of a part, from its content in analysis.json and the pictures and films in `folder`."""
    return render(
        "lab/analysis/templates/section.html",
        title=title,
        findings=part["findings"],
        tables=[_table(table) for table in part["tables"]],
        charts=[_chart(entry) for entry in part["charts"]],
        pictures=[_picture(entry, folder) for entry in part["pictures"]],
        films=[video_of(inside(folder, entry["file"]), folder, entry["caption"]) for entry in part["films"]],
        notes=part["notes"],
    )


def _table(table: Mapping[str, Any]) -> DataTable:
    head = [Cell(str(name)) for name in table["columns"]]
    return DataTable([head], [[Cell(_text(cell)) for cell in row] for row in table["rows"]], table["caption"])


def _text(cell: Any) -> str:
    if cell is None:
        return "–"
    return f"{cell:,}" if isinstance(cell, int | float) else str(cell)


def _chart(entry: Mapping[str, Any]) -> Card:
    chart = chart_from(entry)
    return Card(chart.title, line_chart(chart.series, chart.axes), chart.caption)


def _picture(entry: Mapping[str, Any], folder: Path) -> Picture:
    data = read_bytes(inside(folder, entry["file"]), _MAX_PICTURE_BYTES)
    return Picture(entry["caption"], data_uri("image/png", data))
