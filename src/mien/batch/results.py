"""The results of a batch: one line for each run, comparisons of methods, tables for papers, and the wall."""

import csv
import io
import itertools
import json
import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from mien.batch.plan import Batch
from mien.disk.files import write_atomically
from mien.machine.terminal import counted
from mien.pages.pages import COLUMNS, LIVING_PAGE, render

HEADINGS = {name: heading for name, heading, _, _ in COLUMNS}
HIGHER = {name: higher for name, _, _, higher in COLUMNS}
DIGITS = {name: digits for name, _, digits, _ in COLUMNS}
DIGITS |= {"lpips": 4, "seconds_per_frame": 4, "gaussians": 0, "training_hours": 2}

RESULT_COLUMNS = frozenset(
    {"name", "status", "run", "method", "tries", "host", "mien", "row_seconds", "peak_mb", "error"}
    | {*HIGHER} | {f"head_{name}" for name in HIGHER}
)  # fmt: skip
"""Columns of the results that no label may have."""


def result_rows(batch: Batch) -> list[dict[str, Any]]:
    """One entry for each run of each row, with labels, figures, versions, machine and seconds of stages."""
    found, states = [], batch.read_states()
    for row in batch.read_plan():
        state = states.get(row.name)
        entry: dict[str, Any] = {"name": row.name, "status": state.status if state else "waiting"}
        entry |= row.labels
        for run in (state.runs if state else ()) or ({},):
            about: dict[str, Any] = {}
            if state is not None:
                about = {"tries": state.tries, "host": state.host.partition(",")[0], "mien": state.mien}
                about |= {"row_seconds": state.seconds, "peak_mb": state.peak_mb, "error": state.error}
                about |= {f"{stage}_stage_seconds": seconds for stage, seconds in state.stages.items()}
            found.append({**entry, **run, **about})
    return found


def write_results(batch: Batch) -> list[dict[str, Any]]:
    """Write results.json and results.csv, and return their entries."""
    rows = result_rows(batch)
    columns = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_cell, columns))
    writer.writerows([_cell(row.get(name, "")) for name in columns] for row in rows)
    content = {"format": "mien.batch-results", "version": 1, "rows": rows, "comparison": paired(rows)}
    for name, whole in (("results.csv", text.getvalue()), ("results.json", json.dumps(content, indent=1))):
        write_atomically(batch.root / name, lambda aside, whole=whole: aside.write_text(whole, encoding="utf-8"))
    return rows


def _cell(value: Any) -> Any:
    """A value of a csv. Texts that a spreadsheet would run as a formula begin with an apostrophe."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


def numbers(rows: Iterable[dict[str, Any]], column: str) -> list[float]:
    """The numbers of a column; rows without one are left out."""
    values = (row.get(column) for row in rows)
    return [float(value) for value in values if isinstance(value, int | float) and math.isfinite(value)]


def paired(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means and medians of each method, and paired differences of two methods with 95 % confidence intervals."""
    by_method: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        if row.get("method"):
            by_method.setdefault(row["method"], {})[row["name"]] = row
    found: list[dict[str, Any]] = []
    for metric in (*HIGHER, *(f"head_{name}" for name in HIGHER)):
        for method, own in by_method.items():
            values = numbers(own.values(), metric)
            if values:
                means = {"mean": statistics.fmean(values), "median": statistics.median(values)}
                found.append({"metric": metric, "method": method, "rows": len(values), **means})
        for one, other in itertools.combinations(by_method, 2):
            both = [
                (by_method[one][name], by_method[other][name]) for name in by_method[one] if name in by_method[other]
            ]
            pairs = [pair for first, second in both if len(pair := numbers((first, second), metric)) == 2]
            differences = [first - second for first, second in pairs]
            if differences:
                entry = {"metric": metric, "method": one, "minus": other, "rows": len(differences)}
                found.append({**entry, "mean": statistics.fmean(differences), "interval": interval(differences)})
    return found


def interval(values: Sequence[float]) -> list[float] | None:
    """The 95 % confidence interval of the mean by Student's t distribution; None for a single value."""
    if len(values) < 2:
        return None
    from scipy import stats

    half = stats.t.ppf(0.975, len(values) - 1) * statistics.stdev(values) / math.sqrt(len(values))
    mean = statistics.fmean(values)
    return [float(mean - half), float(mean + half)]


def mean_of(rows: Sequence[dict[str, Any]], column: str) -> str:
    """The mean of a column in words, with the standard deviation of several numbers; "-" if there are none."""
    values, digits = numbers(rows, column), DIGITS.get(column.rpartition(".")[2], 3)
    if not values:
        return "-"
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.{digits}f}{spread}"


def markdown_table(table: Sequence[Sequence[str]]) -> str:
    """The table in Markdown."""
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in table]
    return "\n".join([lines[0], "|" + "---|" * len(table[0]), *lines[1:]]) + "\n"


def latex_table(table: Sequence[Sequence[str]]) -> str:
    """The table in LaTeX, for the package booktabs."""
    lines = [" & ".join(map(_latex, line)) + r" \\" for line in table]
    begin = [rf"\begin{{tabular}}{{l{'r' * (len(table[0]) - 1)}}}", r"\toprule", lines[0], r"\midrule"]
    return "\n".join([*begin, *lines[1:], r"\bottomrule", r"\end{tabular}"]) + "\n"


def _latex(cell: str) -> str:
    special = {"\\": r"\textbackslash{}", "±": r"$\pm$", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    special |= {letter: f"\\{letter}" for letter in "&%$#_{}"}
    return "".join(special.get(letter, letter) for letter in cell)


def write_wall(
    batch: Batch, rows: Sequence[dict[str, Any]], table: Sequence[Sequence[str]] = (), about: Sequence[str] = ()
) -> None:
    """Write index.html: thumbnails that turn, worst first, with a link to each report, and methods compared.

    A paper's `table`, `about` which are its title and its source, takes the place of the comparison.
    """
    shown = [_card(batch, row) for row in rows if row.get("run")]
    shown.sort(key=lambda card: card["figures"].get("psnr", float("-inf")))
    failed = [row for row in rows if not row.get("run") and row["status"] == "failed"]
    compared = [] if table else paired(rows)
    text = render(
        "batch/templates/wall.html",
        heading=batch.root.resolve().name,
        summary=f"{counted(len(shown), 'avatar')}; {counted(len(failed), 'row')} failed",
        cards=shown,
        failed=failed[:200],
        orders=[
            (name, HEADINGS[name], HIGHER[name]) for name in HIGHER if any(name in card["figures"] for card in shown)
        ],
        comparison=[_compared(entry) for entry in compared],
        several=any("minus" in entry for entry in compared),
        table=table,
        about=about,
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
    heading, _, unit = HEADINGS[name].partition(", ")
    return f"{heading} {value:.{DIGITS[name]}f} {unit}".rstrip()


def _compared(entry: dict[str, Any]) -> list[str]:
    digits = DIGITS[entry["metric"].removeprefix("head_")] + 1
    head = "head " if entry["metric"].startswith("head_") else ""
    what = entry["method"] + (f" - {entry['minus']}" if "minus" in entry else "")
    middle = f"{entry['median']:.{digits}f}" if "median" in entry else ""
    ends = entry.get("interval")
    between = f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}" if ends else ""
    figure = head + HEADINGS[entry["metric"].removeprefix("head_")]
    return [figure, what, str(entry["rows"]), f"{entry['mean']:.{digits}f}", middle, between]
