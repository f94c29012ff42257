"""One table over runs: figures from their metrics.json side by side, and whether they may be compared at all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mien.disk.reading import expect_whole
from mien.errors import UserError
from mien.evaluation.metrics_file import (
    BASELINE_NAMES,
    FITTED_NAME,
    OVER_DARK_NAME,
    REMEDY,
    figure,
    read_metrics,
)
from mien.pages.pages import COLUMNS
from mien.training.run import read_run_config


@dataclass(frozen=True, eq=False)
class ScoredRun:
    """A run that was evaluated."""

    label: str
    """Name of the run, with its workspace's name if there are several workspaces."""
    run_dir: Path
    method: str
    metrics: Mapping[str, Any]
    """Content of metrics.json."""


@dataclass(frozen=True, eq=False)
class Row:
    """A line of a table."""

    label: str
    entry: Mapping[str, Any]
    """Figures: `psnr`, ..., `head`: {...}."""
    run: ScoredRun | None
    """The run, or None for baselines and for a run with other face parameters than the headline's."""
    faces: str
    """Source of the face parameters of held-out frames. For a baseline that depends on them: the runs."""
    baseline: bool = False


@dataclass(frozen=True, eq=False)
class Table:
    """One protocol on one set of frames. Its rows may be compared with each other."""

    protocol: str
    split: str
    frames: int
    scored_on: Mapping[str, Any]
    """Hashes of pictures and masks by sequence."""
    edges: str
    """Colours of the truth at soft edges: cleaned or filmed."""
    rows: tuple[Row, ...]

    @property
    def ground(self) -> str:
        """What the frames are scored on, for headings: the split, and whether soft edges are as they were filmed."""
        return self.split + (", soft edges as filmed" if self.edges == "filmed" else "")

    def best(self, part: str | None, metric: str, higher: bool) -> float | None:
        """The best figure of a column among the runs, rounded as printed, or None if fewer than two runs have one."""
        digits = next(digits for name, _, digits, _ in COLUMNS if name == metric)
        own = [figure(row.entry, part, metric) for row in self.rows if row.run is not None]
        known = [round(value, digits) for value in own if value is not None]
        return None if len(known) < 2 else (max(known) if higher else min(known))


@dataclass(frozen=True, eq=False)
class Comparison:
    """All tables, and the warnings that a reader has to know."""

    runs: tuple[ScoredRun, ...]
    tables: tuple[Table, ...]
    warnings: tuple[str, ...]

    def content(self) -> dict[str, Any]:
        """The comparison in a form for json."""
        return {
            "format": "mien.comparison",
            "version": 1,
            "tables": [
                {
                    **{name: getattr(table, name) for name in ("protocol", "split", "frames")},
                    "scored_on": dict(table.scored_on),
                    "edges": table.edges,
                    "rows": [_row_content(row) for row in table.rows],
                }
                for table in self.tables
            ],
            "warnings": list(self.warnings),
        }


def compare_runs(run_dirs: Mapping[str, Path]) -> Comparison:
    """Read the figures of some runs, by label, and sort them into tables of comparable runs."""
    runs, warnings = [], []
    for label, run_dir in run_dirs.items():
        if not (run_dir / "metrics.json").is_file():
            warnings.append(f"{label}: was not evaluated; run `mien evaluate` on it")
            continue
        method = read_run_config(run_dir)["method"]["kind"]
        run = ScoredRun(label, run_dir, method, read_metrics(run_dir))
        with expect_whole(run_dir / "metrics.json", REMEDY):
            _shown(run)
        runs.append(run)
    if not runs:
        listed = ", ".join(run_dirs) or "there is none"
        raise UserError(f"no evaluated run to compare ({listed}); run `mien evaluate DIR --run NAME` first")
    tables, more = _tables(runs)
    return Comparison(tuple(runs), tuple(tables), tuple(warnings + more))


def _shown(run: ScoredRun) -> list[str]:
    """What is shown of a run, as text. A damaged file stumbles here, where its name is known."""
    training, tables = run.metrics["training"], _tables([run])[0]
    texts = [str(Comparison((run,), tuple(tables), ()).content()), *(table.ground for table in tables)]
    for entry in (table.rows[0].entry for table in tables):
        texts += [f"{value:.2f}" for value in (1e3 * entry["seconds_per_frame"], *entry["per_frame"]["head_psnr"])]
        texts.append(", ".join(entry["per_frame"]["sequence"]))
    return [*texts, f"{training['gaussians']:,} {training['seconds']:.0f}"]


def _tables(runs: Sequence[ScoredRun]) -> tuple[list[Table], list[str]]:
    """Tables by protocol and by the scored frames and masks, and warnings if those differ."""
    tables, warnings = [], []
    protocols = dict.fromkeys(
        name for run in runs for name, entry in run.metrics["protocols"].items() if "psnr" in entry
    )
    for protocol in protocols:
        groups: dict[str, list[ScoredRun]] = {}
        for run in runs:
            entry = run.metrics["protocols"].get(protocol)
            if entry is None:
                warnings.append(
                    f"{run.label}: has no {protocol}; it held out other frames or was evaluated with other settings"
                )
                continue
            groups.setdefault(_ground(entry), []).append(run)
        tables += [_table(protocol, group) for group in groups.values()]
        if len(groups) > 1:
            warnings.append(_apart(protocol, list(groups.values())))
    for table in tables:
        warnings += _differences(table)
    return tables, warnings


def _apart(protocol: str, groups: Sequence[Sequence[ScoredRun]]) -> str:
    """A warning that runs have separate tables, what tells them apart, and how to score them alike."""
    entries = [group[0].metrics["protocols"][protocol] for group in groups]
    names = [", ".join(run.label for run in group) for group in groups]
    causes, remedy = [], ""
    if len({_ground({**entry, "edges": ""}) for entry in entries}) > 1:
        causes.append("other frames, pictures or masks")
    if len({entry["edges"] for entry in entries}) > 1:
        causes.append("other soft edges")
        names = [f"{name} ({entry['edges']})" for name, entry in zip(names, entries, strict=True)]
        remedy = "; score them alike with `mien evaluate DIR --run NAME --edges cleaned`"
    return (
        f"{protocol}: these runs have separate tables, because they were scored on {' and '.join(causes)}: "
        f"{' | '.join(names)}{remedy}"
    )


def _ground(entry: Mapping[str, Any]) -> str:
    """Two runs can be compared if they share these: the scored frames, pictures, soft edges and masks."""
    frames = entry["per_frame"]
    keys = ("sequence", "timestep", "camera_id")
    return repr([entry["scored_on"], entry["edges"], entry["pixels"], *(frames[key] for key in keys)])


def _differences(table: Table) -> list[str]:
    """Warnings about other differences between the runs of a table."""
    own = [row for row in table.rows if row.run is not None]
    warnings = []
    if len({row.faces for row in own}) > 1:
        warnings.append(
            f"{table.protocol}: some runs correct the tracking of held-out frames and some do not; compare the rows "
            "with faces as tracked, or train the runs alike"
        )
    if len({(row.entry.get("perceptual_backbone"), row.entry.get("perceptual_frames")) for row in own}) > 1:
        warnings.append(
            f"{table.protocol}: ST-LPIPS was computed on different frames; evaluate the runs with the same settings"
        )
    return warnings


def _table(protocol: str, runs: Sequence[ScoredRun]) -> Table:
    entries = [(run, run.metrics["protocols"][protocol]) for run in runs]
    first = entries[0][1]
    rows = [Row(run.label, entry, run, entry["face_params"].replace("_", " ")) for run, entry in entries]
    corrected = [(run, entry) for run, entry in entries if entry["face_params"] != "as_tracked"]
    rows += [Row(run.label, entry["as_tracked"], None, "as tracked") for run, entry in corrected]
    rows += [Row(run.label, entry["fitted"], None, FITTED_NAME) for run, entry in entries if "fitted" in entry]
    for key, name in BASELINE_NAMES.items():
        rows += _baseline_rows(key, name, runs, protocol)
    # Last, as they are not on the scale of the rows above.
    for run, entry in entries:
        if "over_dark" in entry:
            label = f"{run.label}, {OVER_DARK_NAME}"
            rows.append(Row(label, entry["over_dark"], None, entry["face_params"].replace("_", " ")))
    return Table(protocol, first["split"], first["frames"], first["scored_on"], first["edges"], tuple(rows))


def _baseline_rows(key: str, name: str, runs: Sequence[ScoredRun], protocol: str) -> list[Row]:
    """The row of a baseline, or one row for each run if they differ (the mesh follows a run's corrected faces)."""
    found: dict[str, tuple[list[str], Any]] = {}
    for run in runs:
        entry = run.metrics["protocols"][protocol]["baselines"].get(key)
        if entry is not None:
            found.setdefault(f"{entry['psnr']:.2f} {entry['head']['psnr']:.2f}", ([], entry))[0].append(run.label)
    several = len(found) > 1
    return [Row(name, entry, None, f"as in {', '.join(of)}" if several else "", True) for of, entry in found.values()]


def _row_content(row: Row) -> dict[str, Any]:
    names = [metric for metric, *_ in COLUMNS]
    content: dict[str, Any] = {"label": row.label, "faces": row.faces or None, "baseline": row.baseline}
    content |= {name: figure(row.entry, None, name) for name in names}
    content["head"] = {name: figure(row.entry, "head", name) for name in names}
    if row.run is not None:
        content |= {"run": str(row.run.run_dir), "method": row.run.method, "training": row.run.metrics["training"]}
        content["seconds_per_frame"] = row.entry["seconds_per_frame"]
    return content
