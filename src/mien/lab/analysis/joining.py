"""Statistics over subjects: the same analysis of several runs, joined to one table."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from mien.disk.files import write_atomically, write_json
from mien.lab.analysis.registry import Analysis
from mien.lab.benchmarking.comparing import markdown

FIGURES = {
    "gaussians": "Gaussians", "frame_ms": "Frame, ms", "paper_ms": "Paper: frame, ms", "fps": "Frames/s",
    "paper_fps": "Paper: frames/s", "draw_ms": "Drawing, ms", "step_ms": "Step, ms", "step_ms_median": "Step, ms",
    "head_psnr": "PSNR of the head, dB", "head_ssim": "SSIM", "head_perceptual": "ST-LPIPS",
}  # fmt: skip
"""Figures of rows that are joined, and their headings."""


def joined_rows(parts: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the statistics of one part over subjects: `row, figure, subjects, mean, least, largest` of each figure.

    Rows are joined by name, else by the size of the picture. A subject that lacks a figure does not count in it.
    """
    found: dict[tuple[str, str], list[float]] = {}
    for part in parts:
        rows = part["values"].get("rows", [])
        for row in rows if isinstance(rows, list) else []:
            sized = f"{row['width']}x{row['height']}" if "width" in row else f"step {row.get('step')}"
            for name in FIGURES:
                if row.get(name) is not None:
                    found.setdefault((row.get("name", sized), name), []).append(row[name])
    return [
        {"row": row, "figure": name, "subjects": len(of), "mean": fmean(of), "least": min(of), "largest": max(of)}
        for (row, name), of in found.items()
    ]


def join_analyses(analysis: Analysis, contents: Mapping[str, Mapping[str, Any]], folder: Path) -> dict[str, Any]:
    """Write joined.json and joined.md into a folder, from the content of each subject's analysis.json by its name."""
    parts, lines = {}, []
    for part in analysis.parts:
        rows = joined_rows([each["parts"][part.name] for each in contents.values() if part.name in each["parts"]])
        if rows:
            parts[part.name] = rows
        for row in rows:
            figures = (f"{row[kind]:,.5g}" for kind in ("mean", "least", "largest"))
            lines.append((part.title, row["row"], FIGURES[row["figure"]], str(row["subjects"]), *figures))
    content = {"method": analysis.method, "subjects": list(contents), "parts": parts}
    table = markdown(("part", "row", "figure", "subjects", "mean", "least", "largest"), lines)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "joined.json", "mien.joined_analyses", 1, content)
    write_atomically(folder / "joined.md", lambda aside: aside.write_text(table, encoding="utf-8"))
    return json.loads(json.dumps(content))
