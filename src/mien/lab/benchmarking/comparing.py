"""Rows and tables of `mien bench compare`: several methods on the same frames, with the same budget."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

_QUALITY: tuple[tuple[str, str, int, bool], ...] = (
    ("head.psnr", "head: PSNR, dB", 2, True),
    ("head.ssim", "SSIM", 3, True),
    ("head.perceptual", "ST-LPIPS", 3, False),
    ("eyes.psnr", "eyes: PSNR", 2, True),
    ("eyes.perceptual", "ST-LPIPS", 3, False),
    ("mouth.psnr", "mouth: PSNR", 2, True),
    ("mouth.perceptual", "ST-LPIPS", 3, False),
    ("psnr", "whole frame: PSNR", 2, True),
    ("ssim", "SSIM", 3, True),
    ("l1", "L1", 4, False),
    ("unseen.psnr", "unseen views: PSNR", 2, True),
    ("unseen.perceptual", "ST-LPIPS", 3, False),
)
"""Dotted name, heading, digits, whether higher is better."""
_COST: tuple[tuple[str, str, int, bool], ...] = (
    ("gaussians", "Gaussians", 0, False),
    ("minutes", "training, min", 1, False),
    ("frame_ms", "ms a frame", 1, False),
    ("megabytes", "MB on disk", 1, False),
)


@dataclass(frozen=True)
class MethodRow:
    """One method on one capture."""

    capture: str
    """Name of the workspace or of the reference capture."""
    method: str
    run: str
    """Name of the run in the workspace."""
    steps: int
    seconds: float
    """Seconds of training, without reading and scoring."""
    gaussians: int
    bytes_on_disk: int
    """Size of the avatar's folder in the run."""
    protocols: dict[str, Any]
    """Protocols as in metrics.json, without the figures of single frames."""
    unseen_views: dict[str, Any] = field(default_factory=dict)
    """Figures by angle (`mien.lab.benchmarking.unseen_views`). Empty if the capture has no pictures from the side."""

    def figures(self, protocol: str) -> dict[str, float | None]:
        """Return every number of the table, by its dotted name. None if it was not computed."""
        entry = self.protocols[protocol]
        found: dict[str, float | None] = {metric: entry.get(metric) for metric in ("psnr", "ssim", "l1")}
        for part in ("head", "eyes", "mouth"):
            for metric in ("psnr", "ssim", "perceptual"):
                found[f"{part}.{metric}"] = entry.get(part, {}).get(metric)
        for metric in ("psnr", "perceptual"):
            found[f"unseen.{metric}"] = unseen_mean(self.unseen_views, metric)
        found |= {"gaussians": self.gaussians, "minutes": self.seconds / 60}
        return found | {"frame_ms": 1e3 * entry["seconds_per_frame"], "megabytes": self.bytes_on_disk / 1e6}


def unseen_mean(views: dict[str, Any], metric: str) -> float | None:
    """Return the mean over all angles but the front of an avatar's figure on the head crop, or None."""
    known = [row["avatar"]["head"][metric] for angle, row in views.items() if angle != "front"]
    found = [value for value in known if value is not None]
    return fmean(found) if found else None


def comparison_table(rows: Sequence[MethodRow]) -> str:
    """Return one table in markdown: a row for each capture, protocol and method, then means over the captures.

    The best quality of each capture and protocol is bold. Columns that no row has are left out. Means are over what
    every method has.
    """
    groups: dict[tuple[str, str], list[MethodRow]] = {}
    for row in rows:
        for protocol in row.protocols:
            groups.setdefault((row.capture, protocol), []).append(row)
    every = {key: [(row.method, row.figures(key[1])) for row in own] for key, own in groups.items()}
    columns = [
        column
        for column in (*_QUALITY, *_COST)
        if any(figures[column[0]] is not None for own in every.values() for _, figures in own)
    ]
    lines: list[Sequence[str]] = []
    for (capture, protocol), own in every.items():
        lines += _lines(capture, protocol, own, columns)
    methods = list(dict.fromkeys(row.method for row in rows))
    shared = [own for own in every.values() if {method for method, _ in own} == set(methods)]
    if len(shared) > 1:
        means = [(method, _means(method, shared, columns)) for method in methods]
        lines += _lines(f"mean of {len(shared)}", "all", means, columns)
    return markdown(["capture", "protocol", "method", *(heading for _, heading, _, _ in columns)], lines)


def _means(
    method: str, groups: Sequence[Sequence[tuple[str, dict[str, float | None]]]], columns: Sequence[Any]
) -> dict[str, float | None]:
    """The mean of each column over the groups in which every method has it."""
    found: dict[str, float | None] = {}
    for name, *_ in columns:
        whole = [own for own in groups if all(figures[name] is not None for _, figures in own)]
        known = [
            value for own in whole for one, figures in own if one == method and (value := figures[name]) is not None
        ]
        found[name] = fmean(known) if known else None
    return found


def _lines(
    capture: str, protocol: str, rows: Sequence[tuple[str, dict[str, float | None]]],
    columns: Sequence[tuple[str, str, int, bool]],
) -> list[Sequence[str]]:  # fmt: skip
    """Rows of one group. The best quality is bold if several rows have the figure."""
    best: dict[str, str] = {}
    for name, _, digits, higher in _QUALITY:
        known = [value for _, figures in rows if (value := figures.get(name)) is not None]
        if len(known) > 1:
            choose: Callable[[list[float]], float] = max if higher else min
            best[name] = f"{choose(known):.{digits}f}"
    lines: list[Sequence[str]] = []
    for index, (method, figures) in enumerate(rows):
        cells = []
        for name, _, digits, _ in columns:
            value = figures[name]
            text = "-" if value is None else f"{value:,.{digits}f}"
            cells.append(f"**{text}**" if best.get(name) == text else text)
        first = (capture, protocol.replace("_", " ")) if index == 0 else ("", "")
        lines.append((*first, method, *cells))
    return lines


def known(value: float | None, form: str = "{:.3f}") -> str:
    """A figure for a table; "-" if there is none."""
    return "-" if value is None else form.format(value)


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in markdown. Each line ends with a line break."""
    lines = [" | ".join(heads), *(" | ".join(row) for row in rows)]
    lines = [f"| {line} |" for line in lines]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]]) + "\n"
