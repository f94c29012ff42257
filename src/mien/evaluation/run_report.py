"""report.html: the page of a run."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mien.disk.files import write_atomically
from mien.disk.reading import expect_whole
from mien.evaluation import report_sections as sections
from mien.evaluation.experiment import Experiment
from mien.evaluation.living import FILM, Living
from mien.evaluation.metrics_file import BASELINE_NAMES, FITTED_NAME, OVER_DARK_NAME, PART_NAMES, PROTOCOL_NAMES, figure
from mien.evaluation.page_parts import (
    Cell,
    DataTable,
    Video,
    metric_cells,
    metric_groups,
    metric_headings,
)
from mien.evaluation.protocols import Evaluation
from mien.pages.pages import COLUMNS, LIVING_PAGE, render
from mien.training.footage.coverage import Coverage

_ROWS = {
    "avatar": "Avatar",
    "as_tracked": "Avatar, faces as tracked",
    "fitted": f"Avatar, faces {FITTED_NAME}",
    **{key: BASELINE_NAMES[key].capitalize() for key in ("mesh", "mean_frame")},
    "over_dark": f"Avatar, {OVER_DARK_NAME}",
}


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The records in a run's folder."""

    name: str
    config: Mapping[str, Any]
    """Content of config.json: method, settings, data, mien, command_line."""
    summary: Mapping[str, Any]
    """Content of training.json: steps, seconds, gaussians, step_ms_median, peak_memory_mb."""
    curves: Mapping[str, np.ndarray]
    coverage: Coverage | None = None
    """The part of the head that the training pictures show, if the run kept it."""


def write_report(
    path: Path,
    run: RunRecord,
    protocols: Mapping[str, Any],
    results: Mapping[str, tuple[Experiment, Evaluation]],
    videos: Mapping[str, Video],
    driven: Mapping[str, Any] | None,
    alive: Living | None,
) -> None:
    """Write the page of a run.

    `protocols` is that of metrics.json, `videos` holds a video by protocol, and `driven` is the section on
    cross-reenactment (`report_sections.cross_section`). The film of `alive` lies beside the page.
    """
    first = next(iter(results.values()), None)
    with expect_whole(path.parent, "train and evaluate it again"):
        command_line = list(run.config["command_line"])
        command_line[:1] = [Path(program).name for program in command_line[:1]]  # without the folder of the program
        backbones = {entry["perceptual_backbone"] for entry in protocols.values()} - {None}
        text = render(
            "evaluation/templates/report.html",
            title=f"{', '.join(entry['sequence'] for entry in run.config['data'])} · {run.config['method']['kind']}",
            name=run.name,
            version=run.config["mien"],
            command=shlex.join(command_line),
            hero=sections.hero(alive, path.parent / FILM, first) if alive is not None and first is not None else None,
            page=f"../../{LIVING_PAGE}" if (path.parent / "../.." / LIVING_PAGE).is_file() else None,
            tiles=_tiles(run, protocols),
            tables=_tables(protocols),
            fitted=any("fitted" in entry for entry in protocols.values()),
            backbones=", ".join(sorted(backbones)) or "not computed",
            protocols=[_protocol(name, *result, videos.get(name)) for name, result in results.items()],
            driven=driven,
            training=sections.training_curves(run.curves),
            filmed=sections.confidence(first[0].avatar, run.coverage) if first and run.coverage is not None else None,
            tracking=sections.tracking_overlays(first[0]) if first else None,
            memory=f"{run.summary['peak_memory_mb']:,.0f}",
            config=json.dumps({**run.config, "command_line": command_line}, indent=1),
        )
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def _protocol(name: str, experiment: Experiment, evaluation: Evaluation, video: Video | None) -> dict[str, Any]:
    return {
        "title": PROTOCOL_NAMES.get(name, name),
        "comparison": sections.comparison(experiment, evaluation),
        "video": video,
        "over_time": sections.over_time(experiment, evaluation),
        "baselines": sections.baseline_pictures(experiment, evaluation),
    }


def _tiles(run: RunRecord, protocols: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The few figures to read first, each with its name."""
    tiles: list[tuple[str, str]] = []
    for name, entry in protocols.items():
        where = "" if len(protocols) == 1 else f", {PROTOCOL_NAMES.get(name, name).lower()}"
        tiles.append((f"{entry['psnr']:.2f} dB", f"PSNR, whole frame{where}"))
        tiles.append((f"{entry['head']['psnr']:.2f} dB", f"PSNR, head crop{where}"))
        if entry["head"]["perceptual"] is not None and len(protocols) == 1:
            tiles.append((f"{entry['head']['perceptual']:.3f}", "ST-LPIPS, head crop"))
    summary = run.summary
    tiles.append((f"{summary['gaussians']:,}", "Gaussians"))
    tiles.append((_duration(summary["seconds"]), f"training, {summary['steps']:,} steps"))
    tiles.append((f"{summary['step_ms_median']:.1f} ms", "per step, median"))
    return tiles


def _tables(protocols: Mapping[str, Any]) -> list[DataTable]:
    """Every metric of the avatar and of the baselines: on whole frame and head crop, then on eyes and mouth."""
    tables = []
    for name, entry in protocols.items():
        corrected = {} if entry["face_params"] == "as_tracked" else {"as_tracked": entry["as_tracked"]}
        further = {name: entry[name] for name in ("over_dark", "fitted") if name in entry}
        subjects = {"avatar": entry, **corrected, **further, **entry["baselines"]}
        caption = (
            f"{PROTOCOL_NAMES.get(name, name)} · {entry['frames']} held-out frames ({entry['split']}) · "
            f"face parameters {entry['face_params'].replace('_', ' ')} · PSNR on training frames: "
            f"{entry['training_frames']['psnr']:.2f} dB, head crop {entry['training_frames']['head']['psnr']:.2f} dB"
        )
        if entry["perceptual_frames"]:
            caption += f" · ST-LPIPS on {entry['perceptual_frames']} evenly spread frames"
        if entry["edges"] == "filmed":
            caption += " · soft edges as they were filmed"
        if "covered_frames" in entry:
            caption += f" · in {entry['covered_frames']} of the held-out frames something covers a part of the face"
        head = [[Cell("", "blank"), *metric_groups()], [Cell(""), *metric_headings()]]
        rows = [[Cell(label), *_cells(key, subjects)] for key, label in _ROWS.items() if key in subjects]
        tables.append(DataTable(head, rows, caption, own=True))
        shown = [part for part in PART_NAMES if part in entry]
        if shown:
            tables.append(_parts_table(subjects, shown))
    return tables


def _parts_table(subjects: Mapping[str, Any], parts: Sequence[str]) -> DataTable:
    """Every metric on the crops of eyes and mouth."""
    groups = [Cell(PART_NAMES[part], "group head", len(COLUMNS)) for part in parts]
    head = [[Cell("", "blank"), *groups], [Cell(""), *metric_headings(len(parts))]]
    shown = [key for key in _ROWS if key in subjects and any(part in subjects[key] for part in parts)]
    rows = [[Cell(_ROWS[key]), *metric_cells(subjects[key], parts)] for key in shown]
    return DataTable(head, rows, "Crops of eyes and mouth, in the frames that show them", own=True)


def _cells(key: str, subjects: Mapping[str, Any]) -> list[Cell]:
    """One row's figures. The avatar's PSNR includes its lead over the better baseline."""
    cells = metric_cells(subjects[key], (None, "head"))
    for place, part in ((0, None), (len(COLUMNS), "head")) if key == "avatar" else ():
        value = figure(subjects[key], part, "psnr")
        others = [figure(entry, part, "psnr") for name, entry in subjects.items() if name in BASELINE_NAMES]
        known = [other for other in others if other is not None]
        if value is not None and known:
            cells[place] = replace(cells[place], lead=f"{value - max(known):+.1f}")
    return cells


def _duration(seconds: float) -> str:
    """A time in short words: 45 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if seconds < 600:
        return f"{int(seconds) // 60} min {int(seconds) % 60} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
