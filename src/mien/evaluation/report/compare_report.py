"""compare.html: the tables, and the same held-out frames as rendered by every run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np

from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.evaluation.compare import Comparison, Row, ScoredRun, Table
from mien.evaluation.experiment import Experiment, avatar_image, head_box, target_image
from mien.evaluation.living import FILM
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import PROTOCOL_NAMES, figure
from mien.evaluation.report.page import (
    GLOSSARY,
    Card,
    Cell,
    DataTable,
    Picture,
    figure_text,
    metric_groups,
    metric_headings,
    picture_of,
)
from mien.evaluation.report.report_sections import frame_name
from mien.machine.progress import track_progress
from mien.media.pictures import Box, data_uri, error_heat, picture_uri, to_uint8
from mien.media.video import read_video_frames
from mien.pages.metric_names import COLUMNS
from mien.pages.pages import render
from mien.pages.plots import Axes, Series, line_chart
from mien.training.footage.frames import Frame

_FRAMES = 5
_PICTURE_SIZE = 320
_MAX_RUNS = 8
_PARTS = (None, "head")
_STYLES = ("main", "second", "third", "fourth")
"""Styles of the curves of the first runs. Those of more runs are quiet."""


def write_comparison(path: Path, comparison: Comparison, sequence_dirs: Mapping[Path, Sequence[Path]]) -> None:
    """Write the page.

    Args:
        path: The .html file.
        comparison: The comparison to show.
        sequence_dirs: The folders of the sequences of each run, by the run's folder.
    """
    frames = [_pictures(table, sequence_dirs) for table in comparison.tables]
    text = comparison_html(comparison, frames, _films(comparison.runs, path.parent))
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


@dataclass(frozen=True)
class _DrawnFrame:
    """A held-out frame: the truth and the rendering of every run in a row, their errors below."""

    names: Sequence[str]
    pictures: Sequence[Picture]
    errors: Sequence[Picture]
    notes: Sequence[str]


@dataclass(frozen=True)
class _Film:
    """The film of a run's avatar in motion."""

    label: str
    poster: str
    """Data URI of its first picture."""
    source: str
    """Data URI."""


def comparison_html(
    comparison: Comparison, frames: Sequence[Sequence[_DrawnFrame]], films: Sequence[_Film] = ()
) -> str:
    """The page as text. `frames` holds the drawn frames of each table."""
    return render(
        "evaluation/templates/compare.html",
        runs=", ".join(run.label for run in comparison.runs),
        films=films,
        warnings=comparison.warnings,
        sections=[
            {"heading": _heading(table), "table": _data_table(table), "chart": _chart(table), "frames": shown}
            for table, shown in zip(comparison.tables, frames, strict=True)
        ],
        glossary=GLOSSARY,
    )


def _films(runs: Sequence[ScoredRun], page_folder: Path) -> list[_Film]:
    """The films of the first runs that have one. All show the same motion, so they can be watched side by side."""
    found = [(run.label, run.run_dir / FILM) for run in runs if (run.run_dir / FILM).is_file()]
    return [
        _Film(label, picture_uri(next(read_video_frames(path))[1]), data_uri("video/mp4", path.read_bytes()))
        for label, path in found[:_MAX_RUNS]
    ]


def _chart(table: Table) -> Card:
    """PSNR on the head crop of every held-out frame, by run."""
    runs = [row.run for row in table.rows if row.run is not None]
    series = []
    for run, style in zip_longest(runs, _STYLES[: len(runs)], fillvalue="quiet"):
        assert not isinstance(run, str)
        values = np.array(run.metrics["protocols"][table.protocol]["per_frame"]["head_psnr"], dtype=np.float64)
        series.append(Series(run.label, np.arange(len(values), dtype=np.float64), values, style))
    title = "PSNR on the head crop, dB, over the held-out frames in order"
    return Card(title, line_chart(series, Axes("held-out frame", "PSNR, head crop, dB", 1080, 260)))


def _heading(table: Table) -> str:
    names = ", ".join(dict.fromkeys(table.rows[0].entry["per_frame"]["sequence"]))
    protocol = PROTOCOL_NAMES.get(table.protocol, table.protocol)
    return f"{protocol}: {table.frames} held-out frames of {names} ({table.ground})"


def _data_table(table: Table) -> DataTable:
    groups = [Cell("", "blank", 2), *metric_groups(), Cell("Cost", "group head", 3)]
    costs = [Cell("Gaussians", "head"), Cell("training, s"), Cell("ms/frame")]
    head = [groups, [Cell(""), Cell("faces", "left"), *metric_headings(), *costs]]
    return DataTable(head, [_cells(table, row) for row in table.rows])


def _cells(table: Table, row: Row) -> list[Cell]:
    cells = [Cell(row.label), Cell(row.faces, "left")]
    for part in _PARTS:
        for index, (metric, _, digits, higher) in enumerate(COLUMNS):
            value = figure(row.entry, part, metric)
            best = table.best(part, metric, higher) if row.run is not None else None
            wins = best is not None and value is not None and round(value, digits) == best
            cells.append(Cell(figure_text(value, digits), "head" if part and index == 0 else "", best=wins))
    if row.run is None:
        return [*cells, Cell("", "head"), Cell(""), Cell("")]
    training, milliseconds = row.run.metrics["training"], 1e3 * row.entry["seconds_per_frame"]
    costs = (f"{training['gaussians']:,}", f"{training['seconds']:.0f}", f"{milliseconds:.1f}")
    return [*cells, Cell(costs[0], "head"), *map(Cell, costs[1:])]


def _pictures(table: Table, sequence_dirs: Mapping[Path, Sequence[Path]]) -> list[_DrawnFrame]:
    """Some frames of a table."""
    runs = [row.run for row in table.rows if row.run is not None][:_MAX_RUNS]
    count = len(table.rows[0].entry["per_frame"]["psnr"])
    places = sorted({round(index * (count - 1) / max(1, _FRAMES - 1)) for index in range(_FRAMES)})
    columns: list[list[tuple[Picture, Picture]]] = []
    truths: list[Picture] = []
    captions: list[str] = []
    edges = table.rows[0].entry["edges"]
    for run in track_progress(runs, f"pictures {table.protocol}", len(runs)):
        # One run's avatar and sequences at a time, so that memory does not grow with the number of runs.
        experiment = load_experiments(run.run_dir, sequence_dirs[run.run_dir], edges).get(table.protocol)
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
    drawn = []
    for index, caption in enumerate(captions):
        figures = [run.metrics["protocols"][table.protocol]["per_frame"]["head_psnr"][places[index]] for run in runs]
        drawn.append(
            _DrawnFrame(
                names=["Truth", *(run.label for run in runs)],
                pictures=[truths[index], *(column[index][0] for column in columns)],
                errors=[column[index][1] for column in columns],
                notes=[caption, *(f"head crop {value:.2f} dB" for value in figures)],
            )
        )
    return drawn


def _drawn(experiment: Experiment, frame: Frame, box: Box) -> tuple[Picture, Picture]:
    """A rendering and its error, cut to a box."""
    image, truth = avatar_image(experiment, frame), target_image(experiment, frame)
    cut = crop_to(image, box)
    errors = error_heat(cut, crop_to(truth, box))
    return picture_of(to_uint8(cut), "rendering", _PICTURE_SIZE), picture_of(errors, "error", _PICTURE_SIZE)


def _truth(experiment: Experiment, frame: Frame, box: Box) -> Picture:
    return picture_of(to_uint8(crop_to(target_image(experiment, frame), box)), "truth", _PICTURE_SIZE)
