"""Figures as text for a terminal: a protocol in a few lines, a comparison of runs as an aligned table."""

from collections.abc import Mapping, Sequence
from typing import Any

from mien.evaluation.compare import Comparison, Row, Table
from mien.evaluation.compare_report import costs, row_cells
from mien.evaluation.metrics_file import BASELINE_NAMES, FITTED_NAME, OVER_DARK_NAME
from mien.machine.terminal import printable
from mien.pages.pages import COLUMNS

_BOLD, _PLAIN = "\x1b[1m", "\x1b[0m"
_FURTHER = {"opened": "eroded and dilated", "without_clothes": "the same without clothes"}
"""Words for further figures of a dataset's protocol, by their keys in metrics.json."""
_PARTS = ((None, "whole frame"), ("head", "head crop"))


def protocol_lines(name: str, entry: Mapping[str, Any]) -> list[str]:
    """The PSNR of a protocol of metrics.json: a heading, then a line for the avatar and for each baseline."""
    rows = {f"avatar, faces {entry['face_params'].replace('_', ' ')}": entry}
    if entry["face_params"] != "as_tracked":
        rows["avatar, faces as tracked"] = entry["as_tracked"]
    if "over_dark" in entry:
        rows[f"avatar, {OVER_DARK_NAME}"] = entry["over_dark"]
    if "fitted" in entry:
        rows[f"avatar, faces {FITTED_NAME}"] = entry["fitted"]
    rows |= {BASELINE_NAMES[key]: baseline for key, baseline in entry["baselines"].items()}
    width = max(map(len, rows))
    heading = f"{name} ({entry['split']}, {entry['frames']} frames): PSNR of the whole frame / of the head crop"
    return [
        heading,
        *(f"  {words:<{width}}  {row['psnr']:.2f} / {row['head']['psnr']:.2f} dB" for words, row in rows.items()),
    ]


def dataset_line(entry: Mapping[str, Any]) -> str:
    """The figures of a dataset's protocol in one line, with what they are of."""
    text = f"by the protocol of {entry['dataset_protocol']}: whole frame {_figures(entry)}"
    if entry.get("lpips") is not None:
        text += f" ({entry['lpips_backbone']})"
    for name, words in _FURTHER.items():
        if name in entry:
            text += f"; {words} {_figures(entry[name])}"
    return f"{text}; pixels: {entry['mask']}; SSIM: {entry['ssim_window']}"


def driven_line(entry: Mapping[str, Any]) -> str:
    """Cross-reenactment in one line, with the figures of an avatar that never moves for comparison."""
    text = f"cross_reenactment ({len(entry['drivers'])} drivers, {entry['frames']} frames): "
    if entry["expression_error"] is None:
        return f"{text}no face is found in any picture of the avatar"
    expression, rotation = "expression_error", "head_rotation_error"
    return (
        f"{text}expression error {entry[expression]:.4f} eye distances (an avatar that never moves: "
        f"{entry[f'{expression}_still']:.4f}), head rotation error {entry[f'{rotation}_degrees']:.1f} degrees "
        f"({entry[f'{rotation}_still_degrees']:.1f}), faces found in {100 * entry['faces_found']:.0f} % of frames"
    )


def scores_lines(scores: Mapping[str, Any]) -> list[str]:
    """The figures of `score_folders`, with one line for each part of the picture."""
    lines = [f"{scores['frames']} pictures; whole frame: {_figures(scores)}"]
    if scores["crop"] is None:
        return [*lines, "head crop: unknown; give --crops or --mattes"]
    return [*lines, f"head crop ({scores['crop']}): {_figures(scores['head'])}"]


def comparison_text(comparison: Comparison, bold: bool = False) -> str:
    """All tables of a comparison, then its warnings. With `bold`, the best figures are in bold."""
    parts = [_table_text(table, bold) for table in comparison.tables]
    parts += [printable(f"warning: {warning}") for warning in comparison.warnings]
    return "\n".join(parts)


def _table_text(table: Table, bold: bool) -> str:
    """A heading and an aligned table: first the whole frame, then the head crop."""
    sequences = ", ".join(sorted(set(table.rows[0].entry["per_frame"]["sequence"])))
    title = printable(f"{table.protocol}: {table.frames} held-out frames of {sequences} ({table.ground})")
    headings = [heading for _, heading, _, _ in COLUMNS]
    heads = ["", "faces", *headings, *headings, "Gaussians", "training", "ms/frame"]
    lines = [[(text, False) for text in heads]]
    lines += [_cells(table, row) for row in table.rows]
    widths = [max(len(line[i][0]) for line in lines) for i in range(len(heads))]
    groups = " " * (sum(widths[:2]) + 4)
    count = len(COLUMNS)
    for index, (_, name) in enumerate(_PARTS):
        columns = widths[2 + index * count : 2 + (index + 1) * count]
        groups += f"{name:<{sum(columns) + 2 * count}}"
    body = "\n".join(_line(line, widths, bold) for line in lines)
    return f"{title}\n{groups.rstrip()}\n{body}\n"


def _cells(table: Table, row: Row) -> list[tuple[str, bool]]:
    """The texts of a row, each with whether it is the best of its column."""
    cells = [(printable(row.label), False), (printable(row.faces), False)]
    cells += [(cell.text.replace("–", "-"), cell.best) for cell in row_cells(table, row)]
    gaussians, seconds, milliseconds = costs(row)
    return cells + [(text, False) for text in (gaussians, f"{seconds} s" if seconds else "", milliseconds)]


def _line(cells: Sequence[tuple[str, bool]], widths: Sequence[int], bold: bool) -> str:
    texts = []
    for index, ((text, best), width) in enumerate(zip(cells, widths, strict=True)):
        shown, padding = f"{_BOLD}{text}{_PLAIN}" if bold and best else text, " " * (width - len(text))
        texts.append(shown + padding if index < 2 else padding + shown)
    return "  ".join(texts).rstrip()


def _figures(entry: Mapping[str, Any]) -> str:
    text = f"PSNR {entry['psnr']:.2f} dB, SSIM {entry['ssim']:.4f}, L1 {entry['l1']:.5f}"
    for name, key in (("ST-LPIPS", "perceptual"), ("LPIPS", "lpips")):
        text += f", {name} {entry[key]:.4f}" if entry.get(key) is not None else ""
    return text
