"""report.html: the page of a run."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from mien.evaluation import report_sections as sections
from mien.evaluation.experiment import Experiment
from mien.evaluation.metrics_file import BASELINE_NAMES, COLUMNS, FITTED_NAME, PART_NAMES, figure
from mien.evaluation.page import (
    FITTED_GLOSSARY,
    GLOSSARY,
    ReportVideo,
    glossary_html,
    metric_groups,
    metric_headings,
    page_html,
)
from mien.evaluation.protocols import Evaluation
from mien.storage import write_atomically
from mien.training.coverage import Coverage

_TITLES = {
    "self_reenactment": "Self-reenactment",
    "self_reenactment_tail": "Self-reenactment, last part of the sequence",
    "self_reenactment_sequence": "Self-reenactment, held-out sequences",
    "novel_view": "Novel views, held-out cameras",
}
_ROWS = {
    "avatar": "Avatar",
    "as_tracked": "Avatar, faces as tracked",
    "fitted": f"Avatar, faces {FITTED_NAME}",
    **{key: BASELINE_NAMES[key].capitalize() for key in ("mesh", "mean_frame")},
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
    """What the training pictures show of the head, if the run kept it."""


def write_report(
    path: Path,
    run: RunRecord,
    protocols: Mapping[str, Any],
    results: Mapping[str, tuple[Experiment, Evaluation]],
    videos: Mapping[str, ReportVideo] = MappingProxyType({}),
    driven: str = "",
) -> None:
    """Write the page of a run.

    Args:
        path: The .html file.
        run: The run's own record.
        protocols: `protocols` of metrics.json.
        results: The experiment and every frame's figures, by protocol.
        videos: Side-by-side videos by protocol, in or below the page's folder.
        driven: The section on cross-reenactment, as HTML.
    """
    text = report_html(
        run, protocols, results, {name: video.html(path.parent) for name, video in videos.items()}, driven
    )
    write_atomically(path, lambda aside: aside.write_text(text, encoding="utf-8"))


def report_html(
    run: RunRecord,
    protocols: Mapping[str, Any],
    results: Mapping[str, tuple[Experiment, Evaluation]],
    videos: Mapping[str, str] = MappingProxyType({}),
    driven: str = "",
) -> str:
    """The page as text. `videos` holds a piece of HTML by protocol."""
    title = f"{', '.join(entry['sequence'] for entry in run.config['data'])} · {run.config['method']['kind']}"
    body = [_heading(title, run), _tiles(run, protocols)]
    body += ["<h2>Figures</h2>", _table(protocols), _how_to_read(protocols)]
    for name, (experiment, evaluation) in results.items():
        heading = escape(_TITLES.get(name, name))
        body += [f"<h2>{heading}: held-out frames</h2>", sections.comparison(experiment, evaluation)]
        body.append(videos.get(name, ""))
        body += [f"<h2>{heading}: over time</h2>", sections.over_time(experiment, evaluation)]
        body += ["<h2>Baselines</h2>", sections.baseline_pictures(experiment, evaluation)]
    body.append(driven)
    body += ["<h2>Training</h2>", sections.training_curves(run.curves)]
    first = next(iter(results.values()), None)
    if first is not None and run.coverage is not None:
        body += ["<h2>Filmed and made up</h2>", sections.confidence(first[0].avatar, run.coverage)]
    if first is not None:
        body += ["<h2>Tracking</h2>", sections.tracking_overlays(first[0])]
    body.append(_settings(run))
    return page_html(title, "\n".join(body))


def _heading(title: str, run: RunRecord) -> str:
    command = shlex.join(_shortened(run.config["command_line"]))
    version = escape(str(run.config["mien"]))
    return (
        f"<h1>{escape(title)}</h1>"
        f'<p class="sub">Run {escape(run.name)} · mien {version} · <code>{escape(command)}</code></p>'
    )


def _shortened(command_line: Sequence[str]) -> list[str]:
    """The command as typed, without the folder of the program."""
    return [Path(command_line[0]).name, *command_line[1:]] if command_line else []


def _tiles(run: RunRecord, protocols: Mapping[str, Any]) -> str:
    """The few figures to read first."""
    tiles: list[tuple[str, str]] = []
    for name, entry in protocols.items():
        where = "" if len(protocols) == 1 else f", {_TITLES.get(name, name).lower()}"
        tiles.append((f"{entry['psnr']:.2f} dB", f"PSNR, whole frame{where}"))
        tiles.append((f"{entry['head']['psnr']:.2f} dB", f"PSNR, head crop{where}"))
        if entry["head"]["perceptual"] is not None and len(protocols) == 1:
            tiles.append((f"{entry['head']['perceptual']:.3f}", "ST-LPIPS, head crop"))
    summary = run.summary
    tiles.append((f"{summary['gaussians']:,}", "Gaussians"))
    tiles.append((_duration(summary["seconds"]), f"training, {summary['steps']:,} steps"))
    tiles.append((f"{summary['step_ms_median']:.1f} ms", "per step, median"))
    content = "".join(f'<div class="tile"><b>{value}</b><span>{name}</span></div>' for value, name in tiles)
    return f'<div class="tiles">{content}</div>'


def _table(protocols: Mapping[str, Any]) -> str:
    """Every metric of the avatar and of both baselines, on the whole frame and on the head crop."""
    parts = []
    for name, entry in protocols.items():
        corrected = {} if entry["face_params"] == "as_tracked" else {"as_tracked": entry["as_tracked"]}
        fitted = {"fitted": entry["fitted"]} if "fitted" in entry else {}
        subjects = {"avatar": entry, **corrected, **fitted, **entry["baselines"]}
        rows = "".join(
            f'<tr class="{"own" if key == "avatar" else ""}"><td>{label}</td>{_cells(key, subjects)}</tr>'
            for key, label in _ROWS.items()
            if key in subjects
        )
        caption = (
            f"{_TITLES.get(name, name)} · {entry['frames']} held-out frames ({entry['split']}) · face parameters "
            f"{entry['face_params'].replace('_', ' ')} · PSNR on training frames: "
            f"{entry['training_frames']['psnr']:.2f} dB, head crop {entry['training_frames']['head']['psnr']:.2f} dB"
            f" · ST-LPIPS on {entry['perceptual_frames']} evenly spread frames"
        )
        if "covered_frames" in entry:
            caption += f" · in {entry['covered_frames']} of the held-out frames something covers a part of the face"
        parts.append(
            f'<div class="card table"><div class="scroll"><table>{_table_head()}<tbody>{rows}</tbody></table></div>'
            f'<p class="note">{escape(caption)}</p></div>'
        )
        parts.append(_parts_table(subjects))
    return "".join(parts) or '<p class="note">No frame was held out, so nothing was scored.</p>'


def _parts_table(subjects: Mapping[str, Any]) -> str:
    """Every metric on the crops of eyes and mouth, or nothing if no frame shows them."""
    shown = [part for part in PART_NAMES if part in subjects["avatar"]]
    if not shown:
        return ""
    groups = "".join(f'<th class="group head" colspan="{len(COLUMNS)}">{PART_NAMES[part]}</th>' for part in shown)
    rows = "".join(
        f'<tr class="{"own" if key == "avatar" else ""}"><td>{label}</td>{_part_cells(subjects[key], shown)}</tr>'
        for key, label in _ROWS.items()
        if key in subjects
    )
    head = f'<tr><th class="blank"></th>{groups}</tr><tr><th></th>{metric_headings(len(shown))}</tr>'
    return (
        f'<div class="card table"><div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
        f'<p class="note">Crops of eyes and mouth, in the frames that show them</p></div>'
    )


def _part_cells(entry: Mapping[str, Any], parts: Sequence[str]) -> str:
    cells = []
    for part in parts:
        for index, (metric, _, digits, _) in enumerate(COLUMNS):
            value = figure(entry, part, metric) if part in entry else None
            text = "–" if value is None else f"{value:.{digits}f}"
            cells.append(f"<td{' class=head' if index == 0 else ''}>{text}</td>")
    return "".join(cells)


def _table_head() -> str:
    return f'<thead><tr><th class="blank"></th>{metric_groups()}</tr><tr><th></th>{metric_headings()}</tr></thead>'


def _cells(key: str, subjects: Mapping[str, Any]) -> str:
    """One row's figures. The avatar's PSNR includes its lead over the better baseline."""
    cells = []
    for part in (None, "head"):
        for index, (metric, _, digits, _) in enumerate(COLUMNS):
            value = figure(subjects[key], part, metric)
            text = "–" if value is None else f"{value:.{digits}f}"
            others = [figure(entry, part, metric) for name, entry in subjects.items() if name in BASELINE_NAMES]
            known = [other for other in others if other is not None]
            if key == "avatar" and metric == "psnr" and value is not None and known:
                text += f" <small>{value - max(known):+.1f}</small>"
            cells.append(f"<td{' class=head' if part and index == 0 else ''}>{text}</td>")
    return "".join(cells)


def _how_to_read(protocols: Mapping[str, Any]) -> str:
    backbones = {entry["perceptual_backbone"] for entry in protocols.values()} - {None}
    fitted = FITTED_GLOSSARY if any("fitted" in entry for entry in protocols.values()) else {}
    texts = {
        **GLOSSARY,
        **fitted,
        "ST-LPIPS": f"{GLOSSARY['ST-LPIPS']} Here: {', '.join(sorted(backbones)) or 'not computed'}.",
    }
    return glossary_html(texts)


def _settings(run: RunRecord) -> str:
    shown = {**run.config, "command_line": _shortened(run.config["command_line"])}
    text = json.dumps(shown, indent=1)
    memory = run.summary["peak_memory_mb"]
    return (
        f'<h2>Settings</h2><p class="note">Peak memory {memory:,.0f} MB.</p>'
        f"<details class='card'><summary>config.json</summary><pre><code>{escape(text)}</code></pre></details>"
    )


def _duration(seconds: float) -> str:
    """A time in short words: 45 s, 3 min 20 s, 2 h 5 min."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if seconds < 600:
        return f"{int(seconds) // 60} min {int(seconds) % 60} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
