"""Where a chart goes, checked without the libraries that measure."""

from pathlib import Path

from mien.errors import UserError
from mien.files import check_writable

KINDS = (".png", ".svg", ".pdf")


def check_chart_path(path: Path) -> None:
    """Find out before any measuring whether a chart can be written there.

    Raises:
        UserError: it is no kind of picture that we draw, or its place cannot be written to.
    """
    if path.suffix not in KINDS:
        raise UserError(f"{path}: charts are written as {', '.join(KINDS)}; give a name with one of these endings")
    check_writable(path)
