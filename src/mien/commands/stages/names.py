"""Names that become folders."""

from pathlib import Path

from mien.errors import UserError


def sequence_name(video: Path, name: str | None) -> str:
    """`name`, or the video's name without its ending, if it can be a folder's.

    Raises:
        UserError: it is empty or holds a path separator.
    """
    name = video.stem if name is None else name
    if not name or name in (".", "..") or "/" in name:
        raise UserError(f"{name!r} cannot be the name of a folder; give another with --name or --run")
    return name
