"""Check a chart's path without loading the libraries that measure."""

from pathlib import Path

from mien.disk.files import check_writable
from mien.errors import UserError

KINDS = (".png", ".svg", ".pdf")


def check_chart_path(path: Path) -> None:
    """Check, before anything is measured, that a chart can be written at this path."""
    if path.suffix not in KINDS:
        raise UserError(f"{path}: charts are written as {', '.join(KINDS)}; give a name with one of these endings")
    check_writable(path)
