"""Working sets on other machines: inputs by fsspec URLs, and workspaces that are copied in and out of a store."""

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mien.batch.plan import Batch, Row, State
from mien.batch.row import PROGRAM, attempt
from mien.errors import UserError

_PART = ".mien-part"
"""Ending of a file that is being copied to a store."""
_WHOLE = frozenset({"s3", "gs", "az", "abfs", "memory"})
"""Stores in which a file appears when it is whole."""


def is_url(word: str) -> bool:
    """Whether a word is the URL of a file, such as s3://bucket/clip.mp4, and not a path or an option."""
    scheme, mark, _ = word.partition("://")
    return bool(mark) and scheme.isascii() and scheme.isalnum()


def store_of(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it."""
    import fsspec  # pyright: ignore[reportMissingImports]

    try:
        return fsspec.url_to_fs(url)
    except (ImportError, ValueError) as error:
        why = " ".join(str(error).split())[:200]
        raise UserError(f"{url}: cannot be reached ({why}); `make batch-engines` installs s3fs for s3://") from None


def fetched(word: str, folder: Path) -> str:
    """The word, or the path of a copy in `folder` if it is a URL. A copy that is there is not fetched again."""
    if not is_url(word):
        return word
    target = folder / hashlib.sha256(word.encode()).hexdigest()[:16] / word.rstrip("/").rpartition("/")[2]
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = target.with_name(f".{target.name}")
        fs, path = store_of(word)
        fs.get(path, str(aside), recursive=True)
        aside.rename(target)
    return str(target)


@dataclass(frozen=True)
class Returned:
    """The state and the files that a row sends back if it ran without the batch's folder."""

    state: State | None
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Its thumbnails and its log: path in the batch's folder -> content."""


def attempt_in_store(store: str, row: Row, program: Sequence[str] = PROGRAM, threads: int | None = None) -> Returned:
    """Run a row in a temporary folder of this machine, with its workspace copied in from a store and out to it.

    Args:
        store: URL of the folder of all workspaces, such as s3://bucket/people.
        row: The row.
        program: As for `attempt`.
        threads: As for `attempt`.
    """
    fs, base = store_of(store)
    place = f"{base.rstrip('/')}/{row.name}"
    with tempfile.TemporaryDirectory(prefix="mien-batch-") as scratch:
        batch = Batch(Path(scratch))
        workspace = batch.workspace(row.name)
        if fs.exists(place):
            workspace.parent.mkdir(parents=True)
            fs.get(place, str(workspace), recursive=True)
            for path in list(workspace.rglob(f"*{_PART}")):
                path.unlink()
        state = attempt(batch.root, row, program, threads)
        if workspace.is_dir():
            _copy_out(fs, workspace, place)
        kept = [*batch.root.glob("thumbs/*"), *batch.root.glob("logs/*")]
        return Returned(state, {path.relative_to(batch.root).as_posix(): path.read_bytes() for path in kept})


def _copy_out(fs: Any, workspace: Path, place: str) -> None:
    """Make the store's copy of a workspace equal to it. A kill in between leaves whole files, old or new."""
    ours = set()
    for path in sorted(path for path in workspace.rglob("*") if path.is_file()):
        target = f"{place}/{path.relative_to(workspace).as_posix()}"
        fs.makedirs(target.rpartition("/")[0], exist_ok=True)
        if _WHOLE.isdisjoint([fs.protocol] if isinstance(fs.protocol, str) else fs.protocol):
            fs.put_file(str(path), target + _PART)
            fs.mv(target + _PART, target)
        else:
            fs.put_file(str(path), target)
        ours.add(target)
    for gone in set(fs.find(place)) - ours:
        fs.rm_file(gone)
