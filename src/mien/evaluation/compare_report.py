"""compare.html: the tables, and the same held-out frames as rendered by every run."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from mien.errors import UserError
from mien.evaluation.compare import Comparison, Row, Table
from mien.evaluation.experiment import Experiment, avatar_image, head_box, target_image
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import COLUMNS, figure
from mien.evaluation.page import error_scale, glossary_html, metric_groups, metric_headings, page_html, picture_html
from mien.evaluation.report_sections import frame_name
from mien.pictures import Box, error_heat, to_uint8
from mien.progress import track_progress
from mien.storage import write_atomically
from mien.training.frames import Frame

_FRAMES = 5
_PICTURE_SIZE = 320
_MAX_RUNS = 8
_PARTS = (None, "head")


def write_comparison(path: Path, comparison: Comparison, sequence_dirs: Mapping[Path, Sequence[Path]]) -> None:
    """Write the page.

    Args:
        path: The .html file.
        comparison: The comparison to show.
        sequence_dirs: The folders of the sequences of each run, by the run's folder.
    """
    text = comparison_html(comparison, [_pictures(table, sequence_dirs) for table in comparison.tables])
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def comparison_html(comparison: Comparison, pictures: Sequence[str]) -> str:
    """The page as text. `pictures` holds a piece of HTML for each table."""
    body = ["<h1>Runs compared</h1>"]
    body.append(f'<p class="sub">{escape(", ".join(run.label for run in comparison.runs))}</p>')
    body += [f'<p class="warning">{escape(warning)}</p>' for warning in comparison.warnings]
    for table, shown in zip(comparison.tables, pictures, strict=True):
        body += [f"<h2>{escape(_heading(table))}</h2>", _table_html(table), shown]
    body.append(glossary_html())
    return page_html("runs compared", "\n".join(body), broad=True)


def _heading(table: Table) -> str:
    names = ", ".join(dict.fromkeys(table.rows[0].entry["per_frame"]["sequence"]))
    return f"{table.protocol.replace('_', ' ').capitalize()}: {table.frames} held-out frames of {names} ({table.split})"


def _table_html(table: Table) -> str:
    rows = "".join(_row_html(table, row) for row in table.rows)
    return (
        '<div class="card table"><div class="scroll"><table><thead><tr><th class="blank" colspan="2"></th>'
        f'{metric_groups()}<th class="group head" colspan="3">Cost</th></tr>'
        f"<tr><th></th><th class=left>faces</th>{metric_headings()}"
        f'<th class="head">Gaussians</th><th>training, s</th><th>ms/frame</th></tr></thead><tbody>{rows}</tbody>'
        "</table></div></div>"
    )


def _row_html(table: Table, row: Row) -> str:
    cells = [f"<td>{escape(row.label)}</td><td class=left>{escape(row.faces)}</td>"]
    for part in _PARTS:
        for index, (metric, _, digits, higher) in enumerate(COLUMNS):
            value = figure(row.entry, part, metric)
            best = table.best(part, metric, higher) if row.run is not None else None
            text = "–" if value is None else f"{value:.{digits}f}"
            wins = best is not None and value is not None and round(value, digits) == best
            border = ' class="head"' if part and index == 0 else ""
            cells.append(f"<td{border}>{f'<strong>{text}</strong>' if wins else text}</td>")
    if row.run is None:
        cells.append('<td class="head"></td><td></td><td></td>')
    else:
        training, milliseconds = row.run.metrics["training"], 1e3 * row.entry["seconds_per_frame"]
        cells.append(
            f'<td class="head">{training["gaussians"]:,}</td><td>{training["seconds"]:.0f}</td>'
            f"<td>{milliseconds:.1f}</td>"
        )
    return f"<tr>{''.join(cells)}</tr>"


def _pictures(table: Table, sequence_dirs: Mapping[Path, Sequence[Path]]) -> str:
    """Some frames of a table: the truth and every run's rendering in a row, their errors below."""
    runs = [row.run for row in table.rows if row.run is not None][:_MAX_RUNS]
    count = len(table.rows[0].entry["per_frame"]["psnr"])
    places = sorted({round(index * (count - 1) / max(1, _FRAMES - 1)) for index in range(_FRAMES)})
    columns: list[list[tuple[str, str]]] = []
    truths: list[str] = []
    captions: list[str] = []
    for run in track_progress(runs, f"pictures {table.protocol}", len(runs)):
        # One run's avatar and sequences at a time, so that memory does not grow with the number of runs.
        experiment = load_experiments(run.run_dir, sequence_dirs[run.run_dir]).get(table.protocol)
        if experiment is None or len(experiment.held_out_frames) != count:
            raise UserError(
                f"{run.run_dir / 'metrics.json'}: has figures of other frames than the run held out; evaluate the "
                "run again"
            )
        frames = [experiment.held_out_frames[place] for place in places]
        boxes = [head_box(experiment, [frame]) for frame in frames]
        columns.append([_drawn(experiment, frame, box) for frame, box in zip(frames, boxes, strict=True)])
        if not truths:
            truths = [_truth(experiment, frame, box) for frame, box in zip(frames, boxes, strict=True)]
            captions = [frame_name(experiment, frame) for frame in frames]
    grid = f'style="grid-template-columns:repeat({len(runs) + 1},minmax(0,280px))"'
    body = []
    for index, caption in enumerate(captions):
        heads = "".join(f"<span>{escape(name)}</span>" for name in ["Truth", *(run.label for run in runs)])
        images = truths[index] + "".join(column[index][0] for column in columns)
        errors = error_scale("Error ") + "".join(column[index][1] for column in columns)
        figures = [run.metrics["protocols"][table.protocol]["per_frame"]["head_psnr"][places[index]] for run in runs]
        notes = "".join(f"<span>head crop {value:.2f} dB</span>" for value in figures)
        body.append(
            f'<figure class="row"><div class="labels" {grid}>{heads}</div><div class="triple" {grid}>{images}{errors}'
            f'</div><figcaption class="labels" {grid}><span>{escape(caption)}</span>{notes}</figcaption></figure>'
        )
    return "".join(body)


def _drawn(experiment: Experiment, frame: Frame, box: Box) -> tuple[str, str]:
    """A rendering and its error, cut to a box, as HTML."""
    image, truth = avatar_image(experiment, frame), target_image(experiment, frame)
    cut = crop_to(image, box)
    errors = error_heat(cut, crop_to(truth, box))
    return picture_html(to_uint8(cut), "rendering", _PICTURE_SIZE), picture_html(errors, "error", _PICTURE_SIZE)


def _truth(experiment: Experiment, frame: Frame, box: Box) -> str:
    return picture_html(to_uint8(crop_to(target_image(experiment, frame), box)), "truth", _PICTURE_SIZE)
