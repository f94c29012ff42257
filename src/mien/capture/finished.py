"""Check whether a folder already holds the capture that would be made there."""

from pathlib import Path
from typing import Any

from mien.capture.capture import Capture
from mien.capture.store import FORMAT, JSON_NAME, VERSION, read_capture
from mien.errors import UserError
from mien.progress import say
from mien.storage import read_json


def read_source(out: Path) -> dict[str, Any] | None:
    """Return the `source` entry of the capture in a folder, or None if there is no readable capture."""
    try:
        source = read_json(out / JSON_NAME, FORMAT, VERSION).get("source")
    except UserError:
        return None
    return source if isinstance(source, dict) else None


def read_finished(out: Path, key: str, tell: bool = True) -> Capture | None:
    """Return the capture in a folder if it has this `key` and is intact. `tell` reports a damaged one."""
    source = read_source(out)
    if source is None or source.get("key") != key:
        return None
    try:
        return read_capture(out)
    except UserError as error:
        if tell:
            say(f"{str(error).split('; ')[0]}; it is captured again")
        return None
