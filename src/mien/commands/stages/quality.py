"""Reference captures -> a table of figures, as the command line runs it."""

from pathlib import Path

from mien.errors import UserError


def quality_stage(out: Path, captures: tuple[str, ...], method: str, steps: int, *, as_json: bool) -> None:
    """Walk the reference captures and print their figures."""
    raise UserError(f"{out}: `mien bench quality` is not there yet")
