"""The cache folder of a user: baked face models and tracked drivers."""

import atexit
import os
import tempfile
from functools import lru_cache
from pathlib import Path

from mien.disk.files import check_writable
from mien.disk.reading import remove_tree
from mien.errors import UserError
from mien.machine.progress import say


def cache_folder() -> Path:
    """Return the folder for this user's cached files.

    It is the folder that MIEN_CACHE names, or else ~/.cache/mien (XDG_CACHE_HOME is respected). If that folder has no
    face models yet and cannot be written, for example because there is no home folder, a temporary folder is used and a
    message says so. It is deleted when this process ends.
    """
    obstacle = _obstacle()
    wanted = _wanted_folder()
    return wanted if wanted is not None and obstacle is None else temporary_folder(str(obstacle))


def cache_is_kept() -> bool:
    """Whether the files of the cache folder stay for other commands. Those of a temporary folder are deleted."""
    return _obstacle() is None


def _obstacle() -> str | None:
    """Why the wanted folder cannot be used. None if it can."""
    wanted = _wanted_folder()
    if wanted is None:
        return "there is no home folder"
    if not (wanted / "face_models").is_dir():
        try:
            check_writable(wanted, folder=True)
        except UserError:
            return f"{wanted} cannot be written to"
    return None


@lru_cache(maxsize=1)
def temporary_folder(reason: str) -> Path:
    """Return a folder for this process alone, and say why."""
    folder = Path(tempfile.mkdtemp(prefix="mien-cache-"))
    atexit.register(remove_tree, folder)
    say(f"{reason}: face models are baked into {folder} for this command only; set MIEN_CACHE to keep them")
    return folder


def _wanted_folder() -> Path | None:
    if named := os.environ.get("MIEN_CACHE"):
        return Path(named).expanduser()
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "mien"
    try:
        return Path.home() / ".cache" / "mien"
    except RuntimeError:  # no HOME, and the system does not know the user's home either
        return None
