"""The section of report.html on cross-reenactment."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mien.evaluation.report_video import video_html

_COLUMNS = (
    ("expression_error", "Expression ↓", 4), ("expression_error_still", "if still", 4),
    ("head_rotation_error_degrees", "Head, ° ↓", 2), ("head_rotation_error_still_degrees", "if still", 2),
    ("mouth_correlation", "Mouth r ↑", 2), ("eyes_correlation", "Eyes r ↑", 2), ("faces_found", "Faces found ↑", 2),
    ("frames", "Frames", 0),
)  # fmt: skip
_NOTE = (
    "Motion relative to each one's neutral; there is no true picture. A face detector reads the driver's and the "
    "avatar's pictures alike. Expression: distance between what lips, lids and brows do, head pose taken out, in "
    "distances between the outer eye corners. If still: the same for an avatar that never moves. r: correlation of the "
    "opening of mouth and eyes over the frames. This says how much of the motion arrives, not how good pictures look."
)


def cross_section(entry: Mapping[str, Any], videos: Sequence[Path], page_folder: Path) -> str:
    """The table and the videos, as HTML."""
    heads = "".join(f"<th>{name}</th>" for _, name, _ in _COLUMNS)
    rows = "".join(_row(driver) for driver in entry["drivers"])
    shown = "".join(video_html(path, page_folder, "Driver, avatar") for path in videos)
    return (
        '<h2>Cross-reenactment</h2><div class="card table"><div class="scroll"><table><thead><tr><th>Driver</th>'
        f'{heads}</tr></thead><tbody>{rows}</tbody></table></div><p class="note">{escape(_NOTE)}</p></div>{shown}'
    )


def _row(driver: Mapping[str, Any]) -> str:
    cells = "".join(_cell(driver[key], digits) for key, _, digits in _COLUMNS)
    return f"<tr><td>{escape(driver['driver'])}</td>{cells}</tr>"


def _cell(value: float | int | None, digits: int) -> str:
    return f"<td>{'–' if value is None else f'{value:.{digits}f}'}</td>"
