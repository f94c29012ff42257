"""index.html: a wall of thumbnails that turn, worst first, with a link to each report, and methods compared."""

from collections.abc import Sequence
from typing import Any

from mien.batch.plan import Batch
from mien.batch.results import DIGITS, HIGHER, paired
from mien.disk.files import write_atomically
from mien.machine.terminal import counted
from mien.pages.pages import COLUMNS, LIVING_PAGE, render

_HEADINGS = {name: heading for name, heading, _, _ in COLUMNS}


def write_wall(batch: Batch, rows: Sequence[dict[str, Any]]) -> None:
    """Write the page from the entries of the results."""
    shown = [_card(batch, row) for row in rows if row.get("run")]
    shown.sort(key=lambda card: card["figures"].get("psnr", float("-inf")))
    missing = [
        {"name": row["name"], "status": row["status"], "error": row.get("error", "")}
        for row in rows
        if not row.get("run")
    ]
    failed = [row for row in missing if row["status"] == "failed"]
    compared = paired(rows)
    text = render(
        "batch/templates/wall.html",
        heading=batch.root.resolve().name,
        summary=f"{counted(len(shown), 'avatar')}; {counted(len(failed), 'row')} failed",
        cards=shown,
        failed=failed[:200],
        orders=[
            (name, _HEADINGS[name], HIGHER[name]) for name in HIGHER if any(name in card["figures"] for card in shown)
        ],
        comparison=[_compared(entry) for entry in compared],
        several=any("minus" in entry for entry in compared),
    )
    write_atomically(batch.root / "index.html", lambda aside: aside.write_text(text, encoding="utf-8"))


def _card(batch: Batch, row: dict[str, Any]) -> dict[str, Any]:
    thumbnail = f"thumbs/{row['name']}.{row['run']}.jpg"
    page = f"rows/{row['name']}/{LIVING_PAGE}"
    report = f"rows/{row['name']}/runs/{row['run']}/report.html"
    figures = {name: row[name] for name in HIGHER if isinstance(row.get(name), int | float)}
    return {
        "name": row["name"],
        "run": row["run"],
        "thumbnail": thumbnail if (batch.root / thumbnail).is_file() else None,
        "page": page if (batch.root / page).is_file() else None,
        "report": report if (batch.root / report).is_file() else None,
        "figures": figures,
        "words": [_figure(name, value) for name, value in figures.items()],
    }


def _figure(name: str, value: float) -> str:
    """A figure with its name before it and its unit behind it, such as PSNR 25.31 dB."""
    heading, _, unit = _HEADINGS[name].partition(", ")
    return f"{heading} {value:.{DIGITS[name]}f} {unit}".rstrip()


def _compared(entry: dict[str, Any]) -> list[str]:
    digits = DIGITS[entry["metric"].removeprefix("head_")] + 1
    head = "head " if entry["metric"].startswith("head_") else ""
    what = entry["method"] + (f" - {entry['minus']}" if "minus" in entry else "")
    middle = f"{entry['median']:.{digits}f}" if "median" in entry else ""
    ends = entry.get("interval")
    between = f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}" if ends else ""
    figure = head + _HEADINGS[entry["metric"].removeprefix("head_")]
    return [figure, what, str(entry["rows"]), f"{entry['mean']:.{digits}f}", middle, between]
