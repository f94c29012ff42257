"""compare.html: the tables, and the same held-out frames as rendered by every run."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from mien.camera import Box
from mien.disk.files import write_atomically
from mien.errors import UserError
from mien.evaluation.compare import Comparison, Row, ScoredRun, Table
from mien.evaluation.experiment import Experiment, avatar_image, head_box, target_image
from mien.evaluation.living import FILM
from mien.evaluation.load import load_experiments
from mien.evaluation.metrics import crop_to
from mien.evaluation.metrics_file import PROTOCOL_NAMES
from mien.evaluation.page_parts import (
    Card,
    Cell,
    DataTable,
    Picture,
    metric_cells,
    metric_groups,
    metric_headings,
    picture_of,
)
from mien.evaluation.report_sections import frame_name
from mien.machine.progress import track_progress
from mien.media.pictures import data_uri, error_heat, picture_uri, to_uint8
from mien.media.video import read_video_frames
from mien.pages.pages import Axes, Series, line_chart, render
from mien.training.footage.frames import Frame

_FRAMES = 5
_PICTURE_SIZE = 320
_MAX_RUNS = 8
_STYLES = ("main", "second", "third", "fourth")  # styles of the curves of the first runs. Those of more runs are quiet


def write_comparison(path: Path, comparison: Comparison, sequence_dirs: Mapping[Path, Sequence[Path]]) -> None:
    """Write the page. `sequence_dirs` are the folders of the sequences of each run, by the run's folder."""
    frames = [_pictures(table, sequence_dirs) for table in comparison.tables]
    text = render(
        "evaluation/templates/compare.html",
        runs=", ".join(run.label for run in comparison.runs),
        films=_films(comparison.runs),
        warnings=comparison.warnings,
        sections=[
            {"heading": _heading(table), "table": _data_table(table), "chart": _chart(table), "frames": shown}
            for table, shown in zip(comparison.tables, frames, strict=True)
        ],
    )
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def _films(runs: Sequence[ScoredRun]) -> list[dict[str, str]]:
    """The films of the first runs that have one. All show the same motion, so they can be watched side by side."""
    found = [(run.label, run.run_dir / FILM) for run in runs if (run.run_dir / FILM).is_file()]
    return [
        {
            "label": label,
            "poster": picture_uri(next(read_video_frames(path))[1]),
            "source": data_uri("video/mp4", path.read_bytes()),
        }
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
    gaussians, seconds, milliseconds = costs(row)
    return [
        Cell(row.label), Cell(row.faces, "left"), *row_cells(table, row),
        Cell(gaussians, "head"), Cell(seconds), Cell(milliseconds),
    ]  # fmt: skip


def row_cells(table: Table, row: Row) -> list[Cell]:
    """The figures of a row on the whole frame and on the head crop. Only runs are the best of a column."""
    return metric_cells(row.entry, (None, "head"), table.best if row.run is not None else lambda *_: None)


def costs(row: Row) -> tuple[str, str, str]:
    """Number of Gaussians, seconds of training and milliseconds per frame. Empty for other rows than runs."""
    if row.run is None:
        return "", "", ""
    training = row.run.metrics["training"]
    return f"{training['gaussians']:,}", f"{training['seconds']:.0f}", f"{1e3 * row.entry['seconds_per_frame']:.1f}"


def _pictures(table: Table, sequence_dirs: Mapping[Path, Sequence[Path]]) -> list[dict[str, Any]]:
    """Some frames of a table: the truth and the rendering of every run in a row, and their errors."""
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
            for frame, box in zip(frames, boxes, strict=True):
                cut = to_uint8(crop_to(target_image(experiment, frame), box))
                truths.append(picture_of(cut, "truth", _PICTURE_SIZE))
            captions = [frame_name(experiment, frame) for frame in frames]
    drawn = []
    for index, caption in enumerate(captions):
        figures = [run.metrics["protocols"][table.protocol]["per_frame"]["head_psnr"][places[index]] for run in runs]
        drawn.append(
            {
                "names": ["Truth", *(run.label for run in runs)],
                "pictures": [truths[index], *(column[index][0] for column in columns)],
                "errors": [column[index][1] for column in columns],
                "notes": [caption, *(f"head crop {value:.2f} dB" for value in figures)],
            }
        )
    return drawn


def _drawn(experiment: Experiment, frame: Frame, box: Box) -> tuple[Picture, Picture]:
    """A rendering and its error, cut to a box."""
    cut = crop_to(avatar_image(experiment, frame), box)
    errors = error_heat(cut, crop_to(target_image(experiment, frame), box))
    return picture_of(to_uint8(cut), "rendering", _PICTURE_SIZE), picture_of(errors, "error", _PICTURE_SIZE)
