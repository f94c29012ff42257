"""analysis.html: one page for all parts. Charts, pictures and short films are inside it."""

import shlex
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from mien.analysis.result import chart_from
from mien.analysis.spec import Analysis
from mien.bounded import read_bytes
from mien.evaluation.page import page_html, video_html
from mien.evaluation.plots import line_chart
from mien.inside import inside
from mien.pictures import data_uri
from mien.storage import write_atomically

_MAX_PICTURE_BYTES = 64 << 20
"""Limit of a picture of the page, in bytes."""
_AT_MOST_ITS_SIZE = "width:auto;max-width:100%;max-height:640px"


def write_page(path: Path, analysis: Analysis, content: Mapping[str, Any]) -> None:
    """Write the page.

    Args:
        path: The .html file. Pictures and films are read from its folder.
        analysis: What was analysed.
        content: The content of analysis.json.
    """
    body = [_heading(content)]
    for part in analysis.parts:
        if part.name in content["parts"]:
            body.append(section_html(part.summary, content["parts"][part.name], path.parent))
    title = f"{content['run']} · {analysis.method}"
    text = page_html(f"analysis of {title}", "\n".join([f"<h1>{escape(title)}</h1>", *body]))
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def _heading(content: Mapping[str, Any]) -> str:
    command = escape(shlex.join(["mien", *content["command_line"][1:]]))
    return (
        f'<p class="sub">Beside the figures of {escape(content["paper"])} · mien {escape(content["mien"])} · '
        f"<code>{command}</code></p>"
    )


def section_html(title: str, part: Mapping[str, Any], folder: Path) -> str:
    """The section of a part, from its content in analysis.json and the pictures and films in `folder`."""
    parts = [f"<h2>{escape(title)}</h2>"]
    parts += [f"<p>{escape(text)}</p>" for text in part["findings"]]
    parts += [_table(table) for table in part["tables"]]
    charts = [_chart(entry) for entry in part["charts"]]
    if charts:
        narrow = ' style="max-width:560px"' if len(charts) == 1 else ""
        parts.append(f'<div class="grid2"{narrow}>{"".join(charts)}</div>')
    parts += [_picture(entry, folder) for entry in part["pictures"]]
    parts += [video_html(inside(folder, entry["file"]), folder, entry["caption"]) for entry in part["films"]]
    parts += [f'<p class="note">{escape(note)}</p>' for note in part["notes"]]
    return "\n".join(parts)


def _table(table: Mapping[str, Any]) -> str:
    head = "".join(f"<th>{escape(str(name))}</th>" for name in table["columns"])
    rows = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in table["rows"])
    caption = f'<p class="note">{escape(table["caption"])}</p>' if table["caption"] else ""
    return (
        f'<div class="card table"><div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody>'
        f"</table></div>{caption}</div>"
    )


def _cell(cell: Any) -> str:
    if cell is None:
        return "–"
    return escape(f"{cell:,}" if isinstance(cell, int | float) else str(cell))


def _chart(entry: Mapping[str, Any]) -> str:
    chart = chart_from(entry)
    caption = f'<p class="note">{escape(chart.caption)}</p>' if chart.caption else ""
    return f'<div class="card"><h3>{escape(chart.title)}</h3>{line_chart(chart.series, chart.axes)}{caption}</div>'


def _picture(entry: Mapping[str, Any], folder: Path) -> str:
    source = data_uri("image/png", read_bytes(inside(folder, entry["file"]), _MAX_PICTURE_BYTES))
    caption = escape(entry["caption"])
    image = f'<img style="{_AT_MOST_ITS_SIZE}" alt="{caption}" src="{source}">'
    return f'<figure class="row">{image}<figcaption>{caption}</figcaption></figure>'
